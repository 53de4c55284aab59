"""Folders as other datasets have them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from helpers.corpus.base import CAMERA, FOCAL, FRAMES, HEIGHT, NOISE, STAMPS, WIDTH, colour, depth, png, way
from helpers.corpus.case import Case, Make, Place, Right, Says, all_of, half, options, write

MILLIMETRES = png((depth() // 5).astype(np.uint16))
CAMERA_MATRIX = f"{FOCAL} 0 {(WIDTH - 1) / 2} 0\n0 {FOCAL} {(HEIGHT - 1) / 2} 0\n0 0 1 0\n0 0 0 1\n"
LOST = 4 * b"-inf -inf -inf -inf\n"


def pose(frame: int) -> str:
    """True pose; turned by next to nothing, as orientations that never change are taken for placeholders."""
    x, y = way(frame)
    return f"1 0 0 {x / FOCAL}\n0 1 {-1e-6 * frame} {y / FOCAL}\n0 {1e-6 * frame} 1 0\n0 0 0 1\n"


def take(files: dict[str, bytes]) -> Make:
    """A folder of these files, given as the sequence."""

    def make(place: Place) -> None:
        for name, content in files.items():
            path = place.root / "take" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        place.seq = str(place.root / "take")

    return make


def scannet() -> dict[str, bytes]:
    """The sequence as ScanNet's reader exports one."""
    files = {f"intrinsic/intrinsic_{kind}.txt": CAMERA_MATRIX.encode() for kind in ("color", "depth")}
    for i in range(FRAMES):
        files |= {
            f"color/{i}.png": png(colour(*way(i))),
            f"depth/{i}.png": MILLIMETRES,
            f"pose/{i}.txt": pose(i).encode(),
        }
    return files


def seven_scenes() -> dict[str, bytes]:
    files = {"camera.yaml": CAMERA.replace("5000", "1000").encode()}
    for i in range(FRAMES):
        name = f"frame-{i:06d}"
        files |= {f"{name}.color.png": png(colour(*way(i))), f"{name}.depth.png": MILLIMETRES}
        files[f"{name}.pose.txt"] = pose(i).encode()
    return files


def images() -> dict[str, bytes]:
    """The images alone, with names that are no times."""
    files = {"camera.yaml": CAMERA.encode()}
    for i in range(FRAMES):
        files |= {f"rgb/{i}.png": png(colour(*way(i))), f"depth/{i}.png": png(depth())}
    return files


def changed(files: dict[str, bytes], name: str, change: Callable[[bytes], bytes]) -> Make:
    return take(files | {name: change(files[name])})


def larger_colour(files: dict[str, bytes]) -> dict[str, bytes]:
    """Colour of another camera than depth."""
    return files | {f"color/{i}.png": png(np.zeros((97, 130, 3), np.uint8)) for i in range(FRAMES)}


def without(files: dict[str, bytes], *prefixes: str) -> dict[str, bytes]:
    return {name: content for name, content in files.items() if not name.startswith(prefixes)}


def openloris(sensors: str | bytes) -> Make:
    """The sequence as an OpenLORIS package."""

    def rename(place: Place) -> None:
        (place.folder / "rgb.txt").rename(place.folder / "color.txt")
        (place.folder / "depth.txt").rename(place.folder / "aligned_depth.txt")
        (place.folder / "camera.yaml").unlink()

    return all_of(rename, write("sensors.yaml", sensors))


def icl_nuim(truth: str) -> Make:
    """The sequence as one of ICL-NUIM: frames have numbers."""
    listed = "".join(f"{i} depth/{stamp}.png {i} rgb/{stamp}.png\n" for i, stamp in enumerate(STAMPS))
    return all_of(write("associations.txt", listed), write("traj0.gt.freiburg", truth))


CASES = [
    Case("ScanNet", take(scannet()), Right()),
    Case("ScanNet, a lost pose", changed(scannet(), "pose/3.txt", lambda content: LOST), Right()),
    Case("ScanNet, no poses", take(without(scannet(), "pose")), Right(ate=None)),
    Case(
        "ScanNet, a pose breaks off",
        changed(scannet(), "pose/3.txt", half),
        Says(
            "{root}/take/pose/3.txt: is no matrix of 3 or 4 lines with as many numbers each; copy it again"
            " (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "ScanNet, a pose that is no motion",
        changed(scannet(), "pose/3.txt", lambda content: 4 * b"1 2 3 4\n"),
        Says(
            "{root}/take/pose/3.txt: is not the motion of a camera, a rotation and a place; copy it again"
            " (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "ScanNet, the camera breaks off",
        changed(scannet(), "intrinsic/intrinsic_depth.txt", half),
        Says(
            "{root}/take/intrinsic/intrinsic_depth.txt: is no matrix of 3 or 4 lines with as many numbers"
            " each; copy it again"
        ),
    ),
    Case(
        "ScanNet, a camera of NaN",
        changed(scannet(), "intrinsic/intrinsic_depth.txt", lambda content: 4 * b"nan nan nan nan\n"),
        Says(
            "{root}/take/intrinsic/intrinsic_depth.txt: is no camera matrix, with focal lengths on its"
            " diagonal; copy it again"
        ),
    ),
    Case(
        "ScanNet, a colour camera of zeros",
        changed(larger_colour(scannet()), "intrinsic/intrinsic_color.txt", lambda content: 4 * b"0 0 0 0\n"),
        Says(
            "{root}/take/intrinsic/intrinsic_color.txt: is no camera matrix, with focal lengths on its"
            " diagonal; copy it again"
        ),
    ),
    Case(
        "ScanNet, no depth",
        take(without(scannet(), "depth") | {"depth/x.txt": b""}),
        Says("{root}/take: no colour image has the number of a depth image; do they belong together?"),
    ),
    Case("7-Scenes", take(seven_scenes()), Right()),
    Case(
        "7-Scenes, a pose of words",
        changed(seven_scenes(), "frame-000003.pose.txt", lambda content: b"lost\n"),
        Says(
            "{root}/take/frame-000003.pose.txt: is no matrix of 3 or 4 lines with as many numbers each;"
            " copy it again (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "7-Scenes, an image breaks off",
        changed(seven_scenes(), "frame-000003.depth.png", half),
        Says(
            "{root}/take/frame-000003.depth.png: is truncated or broken; copy or download it again (the"
            " results of the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "7-Scenes, colour without depth",
        take(without(seven_scenes(), *(f"frame-{i:06d}.depth" for i in range(1, FRAMES)))),
        Right(1, ate=None),
    ),
    Case(
        "ICL-NUIM, the truth breaks off",
        icl_nuim("1 2 3\n"),
        Says(
            "{seq}/traj0.gt.freiburg: line 1 is '1 2 3' where stamp tx ty tz qx qy qz qw is expected;"
            " repair it (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "OpenLORIS, a broken camera",
        openloris("%YAML:1.0\nd400_color_optical_frame: [\n"),
        Says("{seq}/sensors.yaml: is no YAML as OpenCV writes it (...); copy it again"),
    ),
    Case(
        "OpenLORIS, no camera",
        openloris("%YAML:1.0\nt265_fisheye1_optical_frame:\n   width: 848\n"),
        Says(
            "{seq}/sensors.yaml: holds no d400_color_optical_frame with width, height, intrinsics; copy it"
            " again, or give --camera"
        ),
    ),
    Case(
        "OpenLORIS, a matrix that OpenCV falls over",
        openloris(
            "%YAML:1.0\nd400_color_optical_frame:\n   intrinsics: !!opencv-matrix\n      rows: 1\n      col: 4\n"
            "      dt: d\n      data: [ 1., 2. ]\n"
        ),
        Says(
            "{seq}/sensors.yaml: holds no d400_color_optical_frame with width, height, intrinsics; copy it"
            " again, or give --camera"
        ),
    ),
    Case(
        "OpenLORIS, a camera of noise",
        openloris(NOISE),
        Says("{seq}/sensors.yaml: is not a UTF-8 text file; convert it to UTF-8 (it is YAML as OpenCV writes it)"),
    ),
    Case(
        "images without times",
        take(images()),
        Says("{root}/take: names such as 0.png are no times; give the frames a second with --fps"),
    ),
    Case("images without times, --fps", all_of(take(images()), options("--fps", "10")), Right(ate=None)),
    Case(
        "images, one without depth",
        all_of(take(without(images(), "depth/7")), options("--fps", "10")),
        Right(7, ate=None),
    ),
    Case(
        "images whose names have nothing in common",
        all_of(take(without(images(), "depth") | {"depth/a.png": png(depth())}), options("--fps", "10")),
        Says(
            "{root}/take: has 8 colour and 1 depth images whose names have nothing in common; name those"
            " that belong together alike"
        ),
    ),
    Case(
        "images in too many folders",
        all_of(take(images() | {"rgb_right/0.png": png(colour(0))}), options("--fps", "10")),
        Says("{root}/take: holds rgb, rgb_right, depth; leave one folder of colour and one of depth images there"),
    ),
]
