"""Exceptions of the package: library code raises them, the commands turn them into one sentence and exit code 2."""


class V3DError(Exception):
    """Base of every error that a user can act on. The message is one sentence that names the cause and the cure."""


class InputError(V3DError):
    """A file or folder given as input is missing, truncated or not what it should be."""


class ConfigError(V3DError):
    """A configuration names an unknown key or holds a value of the wrong type or range."""


class DownloadError(V3DError):
    """A download failed: no network, a wrong size or a wrong checksum."""


class WeightsError(V3DError):
    """Network weights cannot be found, do not match their checksum or are not what their name says."""


class ViewerError(V3DError):
    """A viewer cannot be shown: its library is missing, or there is no screen."""


class OutputError(V3DError):
    """A result cannot be written: no permission, disk full."""


class GroundTruthWarning(UserWarning):
    """The ground truth of a sequence cannot be read: its frames can, and are given without true poses."""


class NumericsError(V3DError):
    """A stage gave a number that is NaN or infinite; raised in debug mode, see `v3d_torch.runs.numerics_check`."""
