"""Exceptions of the package. Library code raises them; the commands print them as one line and exit with code 2."""


class V3DError(Exception):
    """Base class of all errors that a user can fix. The message is one line: the path, the cause, the fix."""


class InputError(V3DError):
    """An input file or folder is missing, damaged or not valid."""


class ConfigError(V3DError):
    """A configuration has an unknown key, or a value of the wrong type or range."""


class StageError(V3DError):
    """A stage that the configuration names by its import path raised an error, which is the cause of this one."""


class DownloadError(V3DError):
    """A download failed: no network, wrong size or wrong checksum."""


class WeightsError(V3DError):
    """The weights of the network are missing, do not match their checksum or do not fit the model."""


class ViewerError(V3DError):
    """A viewer cannot be started: its library is missing, or there is no screen."""


class OutputError(V3DError):
    """A result cannot be written: no permission, or the disk is full."""


class RunError(V3DError):
    """A run, or a run of a batch, ended early or has incomplete results."""


class LockedError(OutputError):
    """Another run or batch is writing to the folder of the results."""


class GroundTruthWarning(UserWarning):
    """The ground truth of a sequence cannot be read. Its frames are available without true poses."""


class DepthScaleWarning(UserWarning):
    """The depth scale of a sequence is not stated, and was estimated from its images."""


class StageWarning(UserWarning):
    """A saved system had stages that were set in Python, which the loaded system lacks."""


class NumericsError(V3DError):
    """A stage returned NaN or infinity; raised in debug mode by `v3d_torch.runs.numerics_check.CheckedSLAM`."""
