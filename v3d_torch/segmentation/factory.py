"""Construction of the segmenter that a configuration selects."""

from __future__ import annotations

from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.paths import StrPath
from v3d_torch.runtime.stage_import import make_stage
from v3d_torch.segmentation.mask_files import MaskFolder
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.segmentation.yolo import YOLOSegmenter
from v3d_torch.types import Instances, RGBDFrame, Segmenter


class NoSegmentation:
    """Segmenter that never finds an instance: the baseline without masks."""

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Return an empty set of instances of the frame's size."""
        return Instances.empty(*frame.image.shape[1:])


def make_segmenter(
    config: Config, camera: PinholeCamera, weights: StrPath | None = None, masks_dir: StrPath | None = None
) -> Segmenter:
    """Create the segmenter for one run: the one with the import path ``stages.segment``, else that of the package.

    The network of the package gets upright images if configured. Use a new segmenter for each run: `UprightSegmenter`
    accumulates votes over the frames of a run.

    Args:
        config: Configuration of the run.
        camera: Camera of the run.
        weights: As for `make_instance_source`.
        masks_dir: As for `make_instance_source`.

    Raises:
        ConfigError: If a segmenter is given by its import path, and it cannot be made or there is also another source;
            and as `make_instance_source`.
        WeightsError: As `make_instance_source`.
        InputError: As `make_instance_source`.
    """
    source, path = config.segmentation.source, config.stages.segment
    if path is None:
        return wrap_upright(make_instance_source(config.segmentation, weights, masks_dir), config.segmentation)
    others = [f"--weights {weights}"] if weights is not None else []
    others += [f"--masks {masks_dir}"] if masks_dir is not None else []
    others += [f"segmentation.source={source}"] if source != "yolo" else []
    for other in others:
        _check_no_stage(other, config)
    return make_stage("segment", path, config, camera)


def check_network_is_used(option: str, config: Config) -> None:
    """Check that an option of the network has an effect.

    Args:
        option: Option as it is typed, such as ``--model yolo11n-seg``.
        config: Configuration of the run.

    Raises:
        ConfigError: If the segmenter of the configuration is not the network.
    """
    _check_no_stage(option, config)
    _check_source(option, "yolo", config.segmentation)


def _check_no_stage(option: str, config: Config) -> None:
    """Raise `ConfigError` if the segmenter is given by its import path, and has no such option."""
    if (path := config.stages.segment) is not None:
        raise ConfigError(f"{option}: not used with stages.segment={path}; remove one of them")


def _check_source(option: str, source: str, config: SegmentationConfig) -> None:
    """Raise `ConfigError` if the source of instances is not the one to which an option belongs."""
    if config.source != source:
        raise ConfigError(
            f"{option}: not used with segmentation.source={config.source}; remove it, or add --segmenter {source}"
        )


def wrap_upright(source: Segmenter, config: SegmentationConfig) -> Segmenter:
    """Wrap a network in `UprightSegmenter` if configured; return any other source unchanged."""
    return UprightSegmenter(source) if config.upright and config.source == "yolo" else source


def make_instance_source(
    config: SegmentationConfig, weights: StrPath | None = None, masks_dir: StrPath | None = None
) -> Segmenter:
    """Create the source of instances, which segments each image independently of all others.

    Args:
        config: Configuration of the segmentation; ``config.source`` selects the kind of source.
        weights: Weights of the network, see `YOLOSegmenter`; allowed only if the source is the network.
        masks_dir: Folder of id images, see `MaskFolder`; required if masks are the source, else not allowed.

    Raises:
        ConfigError: If ``weights`` or ``masks_dir`` does not fit the source, or the folder of masks is not given.
        WeightsError: If the weights of the network are not available.
        InputError: If the folder contains no masks.
    """
    for option, value, source in (("weights", weights, "yolo"), ("masks", masks_dir, "masks")):
        if value is not None:
            _check_source(f"--{option} {value}", source, config)
    if config.source == "none":
        return NoSegmentation()
    if config.source == "masks":
        if masks_dir is None:
            raise ConfigError(
                "segmentation.source=masks: the folder of the id images is missing; only `run` takes one, with --masks"
            )
        return MaskFolder(masks_dir)
    return YOLOSegmenter(config, weights)
