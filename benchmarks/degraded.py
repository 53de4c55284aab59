"""ATE with degraded images, beside ORB-SLAM3, as Markdown.

``python benchmarks/degraded.py --seqs fr1_rpy`` writes each sequence anew with fewer frames, less light, blur, noisy
depth or half the resolution, and runs this package and pyorbslam3 on it. All systems read the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import columns
import torch
from accuracy import accuracy_rows, run, run_peer
from command import add_sequences_option, add_vocabulary_option, make_parser, publish_rows
from kornia.filters import gaussian_blur2d
from sequences import trained_vocabulary
from storage import Row
from tables import accuracy_cell
from torch import Tensor
from torch.nn.functional import avg_pool2d

from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.errors import V3DError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame

PEER = "pyorbslam3"


def nothing(frame: RGBDFrame) -> RGBDFrame:
    """Return the frame as it is."""
    return frame


def with_little_light(frame: RGBDFrame) -> RGBDFrame:
    """Return the frame with 0.3 times the brightness, and noise with a standard deviation of 3 grey levels."""
    dark = 0.3 * frame.image
    return replace(frame, image=to_bytes(dark + 3 * torch.randn(dark.shape, generator=generator(frame))))


def with_blur(frame: RGBDFrame) -> RGBDFrame:
    """Return the frame with a colour image that is blurred by 2 pixels, as out of focus."""
    blurred = gaussian_blur2d(frame.image[None].float(), (13, 13), (2.0, 2.0))[0]
    return replace(frame, image=to_bytes(blurred))


def with_noisy_depth(frame: RGBDFrame) -> RGBDFrame:
    """Return the frame with depth noise of 3 mm at 1 m, and without the depth of a tenth of the pixels.

    The noise increases with the square of the depth: about twice that of a structured-light camera.
    """
    random = generator(frame)
    noise = 0.003 * frame.depth.square() * torch.randn(frame.depth.shape, generator=random)
    kept = torch.rand(frame.depth.shape, generator=random) >= 0.1
    return replace(frame, depth=(frame.depth + noise).clamp(min=0) * kept)


def with_half_the_resolution(frame: RGBDFrame) -> RGBDFrame:
    """Return the frame with 2 x 2 pixels combined: mean colour, and the depth of the first one."""
    image = avg_pool2d(frame.image[None].float(), 2)[0]
    return replace(frame, image=to_bytes(image), depth=frame.depth[:, ::2, ::2].contiguous())


def half(camera: PinholeCamera) -> PinholeCamera:
    """Return the camera of images with half the resolution."""
    centre = {"cx": (camera.cx - 0.5) / 2, "cy": (camera.cy - 0.5) / 2}
    size = {"width": camera.width // 2, "height": camera.height // 2}
    return replace(camera, fx=camera.fx / 2, fy=camera.fy / 2, **centre, **size)


def to_bytes(image: Tensor) -> Tensor:
    """Round colours to uint8."""
    return image.round().clamp(0, 255).to(torch.uint8)


def generator(frame: RGBDFrame) -> torch.Generator:
    """Return a source of noise that depends only on the index of the frame."""
    return torch.Generator().manual_seed(frame.index)


@dataclass(frozen=True)
class Degradation:
    """Change of the images of a sequence.

    Attributes:
        frame: Changes a frame.
        camera: Changes the camera in the same way.
        step: Step between the frames that are kept.
    """

    frame: Callable[[RGBDFrame], RGBDFrame] = nothing
    camera: Callable[[PinholeCamera], PinholeCamera] = lambda camera: camera
    step: int = 1


DEGRADATIONS = {
    "none": Degradation(),
    "every second frame": Degradation(step=2),
    "0.3 times the light, noise of 3 grey levels": Degradation(with_little_light),
    "blurred by 2 pixels": Degradation(with_blur),
    "depth noise of 3 mm at 1 m, a tenth missing": Degradation(with_noisy_depth),
    "half the resolution": Degradation(with_half_the_resolution, half),
}
"""Degradations by their names in tables."""


def write(sequence: RGBDSequence, degradation: Degradation, folder: Path) -> None:
    """Write a degraded sequence in TUM layout."""
    with TUMWriter(folder, degradation.camera(sequence.camera), sequence.groundtruth) as writer:
        for index in range(0, len(sequence), degradation.step):
            writer.add(degradation.frame(sequence[index]))


def measure(source: str, seeds: int, data_root: Path, vocabulary: Path) -> Iterator[Row]:
    """Yield a row per degradation."""
    sequence = load_sequence(source, data_root=data_root)
    for name, degradation in DEGRADATIONS.items():
        with TemporaryDirectory() as folder:
            degraded = Path(folder) / sequence.name
            write(sequence, degradation, degraded)
            ours = [run(str(degraded), "full", seed, data_root) for seed in range(seeds)]
            peer = [run_peer(str(degraded), PEER, turn, data_root, vocabulary) for turn in range(seeds)]
        cells = {row["system"]: accuracy_cell(row) for row in accuracy_rows([*ours, *peer])}
        yield {"sequence": Path(source).name, "degradation": name, "ours": cells["full"], "peer": cells[PEER]}


def main() -> None:
    """Degrade the sequences, run both systems and print the table."""
    parser = make_parser("ATE with degraded images, as Markdown.")
    add_sequences_option(parser, "ground truth")
    parser.add_argument("--seeds", type=int, default=3, help="number of runs of each system [3]")
    add_vocabulary_option(parser)
    options = parser.parse_args()
    try:
        vocabulary = options.vocabulary or trained_vocabulary(options.seqs, options.data_root)
    except V3DError as error:
        parser.error(str(error))
    publish_rows(
        parser,
        options,
        "degraded",
        columns.DEGRADED,
        lambda source: measure(source, options.seeds, options.data_root, vocabulary),
        peers=(PEER,),
    )


if __name__ == "__main__":
    main()
