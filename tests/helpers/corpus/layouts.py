"""Folders in the layouts of other datasets."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np

from helpers.corpus.base import CAMERA, FOCAL, FRAMES, HEIGHT, NOISE, STAMPS, WIDTH, camera_position, colour, depth, png
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    Workspace,
    add_options,
    all_of,
    fails_after_run,
    fails_at_frame,
    first_half,
    write,
)

MILLIMETRES = png((depth() // 5).astype(np.uint16))
CAMERA_MATRIX = f"{FOCAL} 0 {(WIDTH - 1) / 2} 0\n0 {FOCAL} {(HEIGHT - 1) / 2} 0\n0 0 1 0\n0 0 0 1\n"
LOST = 4 * b"-inf -inf -inf -inf\n"


def pose(frame: int) -> str:
    """True pose, with a tiny rotation: constant orientations count as placeholders in the evaluation."""
    x, y = camera_position(frame)
    return f"1 0 0 {x / FOCAL}\n0 1 {-1e-6 * frame} {y / FOCAL}\n0 {1e-6 * frame} 1 0\n0 0 0 1\n"


def use_files(files: dict[str, bytes]) -> Damage:
    """Write these files to a new folder and use it as the sequence."""

    def make(place: Workspace) -> None:
        for name, content in files.items():
            path = place.root / "take" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        place.seq = str(place.root / "take")

    return make


def scannet() -> dict[str, bytes]:
    """Files of the sequence as exported by ScanNet's SensReader."""
    files = {f"intrinsic/intrinsic_{kind}.txt": CAMERA_MATRIX.encode() for kind in ("color", "depth")}
    for i in range(FRAMES):
        files |= {
            f"color/{i}.png": png(colour(*camera_position(i))),
            f"depth/{i}.png": MILLIMETRES,
            f"pose/{i}.txt": pose(i).encode(),
        }
    return files


def seven_scenes() -> dict[str, bytes]:
    """Files of the sequence in the layout of 7-Scenes."""
    files = {"camera.yaml": CAMERA.replace("5000", "1000").encode()}
    for i in range(FRAMES):
        name = f"frame-{i:06d}"
        files |= {f"{name}.color.png": png(colour(*camera_position(i))), f"{name}.depth.png": MILLIMETRES}
        files[f"{name}.pose.txt"] = pose(i).encode()
    return files


def replica() -> dict[str, bytes]:
    """Files of the sequence in the layout of the sequences rendered from Replica."""
    camera = {"w": WIDTH, "h": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    files = {"cam_params.json": json.dumps({"camera": camera | {"scale": 1000.0}}).encode()}
    files["traj.txt"] = "".join(pose(i).replace("\n", " ") + "\n" for i in range(FRAMES)).encode()
    for i in range(FRAMES):
        files[f"results/frame{i:06d}.png"] = png(colour(*camera_position(i)))
        files[f"results/depth{i:06d}.png"] = MILLIMETRES
    return files


def images() -> dict[str, bytes]:
    """Images without lists, with names that are not timestamps."""
    files = {"camera.yaml": CAMERA.encode()}
    for i in range(FRAMES):
        files |= {f"rgb/{i}.png": png(colour(*camera_position(i))), f"depth/{i}.png": png(depth())}
    return files


def changed(files: dict[str, bytes], name: str, change: Callable[[bytes], bytes]) -> Damage:
    """Use these files as the sequence, after a change of one of them."""
    return use_files(files | {name: change(files[name])})


def larger_colour(files: dict[str, bytes]) -> dict[str, bytes]:
    """Replace the colour images by larger ones, which need the colour camera."""
    return files | {f"color/{i}.png": png(np.zeros((97, 130, 3), np.uint8)) for i in range(FRAMES)}


def without(files: dict[str, bytes], *prefixes: str) -> dict[str, bytes]:
    """Remove the files whose names begin with a prefix."""
    return {name: content for name, content in files.items() if not name.startswith(prefixes)}


def openloris(sensors: str | bytes) -> Damage:
    """Convert the sequence to an OpenLORIS package."""

    def rename(place: Workspace) -> None:
        (place.folder / "rgb.txt").rename(place.folder / "color.txt")
        (place.folder / "depth.txt").rename(place.folder / "aligned_depth.txt")
        (place.folder / "camera.yaml").unlink()

    return all_of(rename, write("sensors.yaml", sensors))


def icl_nuim(groundtruth: str) -> Damage:
    """Convert the sequence to the layout of ICL-NUIM, with frame numbers instead of timestamps."""
    listed = "".join(f"{i} depth/{stamp}.png {i} rgb/{stamp}.png\n" for i, stamp in enumerate(STAMPS))
    return all_of(write("associations.txt", listed), write("traj0.gt.freiburg", groundtruth))


CASES = [
    Case("ScanNet", use_files(scannet()), Succeeds()),
    Case("ScanNet, lost pose", changed(scannet(), "pose/3.txt", lambda content: LOST), Succeeds()),
    Case("ScanNet, no poses", use_files(without(scannet(), "pose")), Succeeds(max_ate=None)),
    Case(
        "ScanNet, truncated pose",
        changed(scannet(), "pose/3.txt", first_half),
        fails_after_run("{root}/take/pose/3.txt: is not a 3x3 or 4x4 matrix; copy it again"),
    ),
    Case(
        "ScanNet, pose that is not a rigid transform",
        changed(scannet(), "pose/3.txt", lambda content: 4 * b"1 2 3 4\n"),
        fails_after_run("{root}/take/pose/3.txt: is not a valid rigid transform; copy it again"),
    ),
    Case(
        "ScanNet, truncated camera",
        changed(scannet(), "intrinsic/intrinsic_depth.txt", first_half),
        Fails("{root}/take/intrinsic/intrinsic_depth.txt: is not a 3x3 or 4x4 matrix; copy it again"),
    ),
    Case(
        "ScanNet, camera of NaN",
        changed(scannet(), "intrinsic/intrinsic_depth.txt", lambda content: 4 * b"nan nan nan nan\n"),
        Fails(
            "{root}/take/intrinsic/intrinsic_depth.txt: is not a camera matrix with focal lengths of at least 1"
            " pixel on its diagonal; copy it again"
        ),
    ),
    Case(
        "ScanNet, colour camera of zeros",
        changed(larger_colour(scannet()), "intrinsic/intrinsic_color.txt", lambda content: 4 * b"0 0 0 0\n"),
        Fails(
            "{root}/take/intrinsic/intrinsic_color.txt: is not a camera matrix with focal lengths of at least 1"
            " pixel on its diagonal; copy it again"
        ),
    ),
    Case(
        "ScanNet, no depth",
        use_files(without(scannet(), "depth") | {"depth/x.txt": b""}),
        Fails(
            "{root}/take: no colour image has the same frame number as a depth image; check that both belong to"
            " the same recording"
        ),
    ),
    Case("7-Scenes", use_files(seven_scenes()), Succeeds()),
    Case(
        "7-Scenes, pose of words",
        changed(seven_scenes(), "frame-000003.pose.txt", lambda content: b"lost\n"),
        fails_after_run("{root}/take/frame-000003.pose.txt: is not a 3x3 or 4x4 matrix; copy it again"),
    ),
    Case(
        "7-Scenes, truncated image",
        changed(seven_scenes(), "frame-000003.depth.png", first_half),
        fails_at_frame(3, "{root}/take/frame-000003.depth.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "7-Scenes, colour without depth",
        use_files(without(seven_scenes(), *(f"frame-{i:06d}.depth" for i in range(1, FRAMES)))),
        Succeeds(1, max_ate=None),
    ),
    Case("Replica", use_files(replica()), Succeeds()),
    Case(
        "Replica, truncated poses",
        changed(replica(), "traj.txt", first_half),
        fails_after_run("{root}/take/traj.txt: line ... is not a 4x4 matrix of 16 numbers; copy it again"),
    ),
    Case(
        "ICL-NUIM, truncated ground truth",
        icl_nuim("1 2 3\n"),
        fails_after_run(
            "{seq}/traj0.gt.freiburg: line 1 is '1 2 3', expected timestamp tx ty tz qx qy qz qw; correct or remove it"
        ),
    ),
    Case(
        "OpenLORIS, invalid camera file",
        openloris("%YAML:1.0\nd400_color_optical_frame: [\n"),
        Fails("{seq}/sensors.yaml: is not valid OpenCV YAML (...); copy it again"),
    ),
    Case(
        "OpenLORIS, no camera",
        openloris("%YAML:1.0\nt265_fisheye1_optical_frame:\n   width: 848\n"),
        Fails(
            "{seq}/sensors.yaml: has no d400_color_optical_frame with width, height and intrinsics; copy it"
            " again, or pass --camera"
        ),
    ),
    Case(
        "OpenLORIS, matrix that crashes OpenCV",
        openloris(
            "%YAML:1.0\nd400_color_optical_frame:\n   intrinsics: !!opencv-matrix\n      rows: 1\n      col: 4\n"
            "      dt: d\n      data: [ 1., 2. ]\n"
        ),
        Fails(
            "{seq}/sensors.yaml: has no d400_color_optical_frame with width, height and intrinsics; copy it"
            " again, or pass --camera"
        ),
    ),
    Case(
        "OpenLORIS, camera file of random bytes",
        openloris(NOISE),
        Fails("{seq}/sensors.yaml: is not a UTF-8 text file; convert it to UTF-8 (it contains YAML written by OpenCV)"),
    ),
    Case(
        "images without timestamps",
        use_files(images()),
        Fails("{root}/take: file names such as 0.png are not timestamps; pass the frame rate with --fps"),
    ),
    Case(
        "images without timestamps, with --fps",
        all_of(use_files(images()), add_options("--fps", "10")),
        Succeeds(max_ate=None),
    ),
    Case(
        "images, one without depth",
        all_of(use_files(without(images(), "depth/7")), add_options("--fps", "10")),
        Succeeds(7, max_ate=None),
    ),
    Case(
        "images that cannot be paired",
        all_of(use_files(without(images(), "depth") | {"depth/a.png": png(depth())}), add_options("--fps", "10")),
        Fails(
            "{root}/take: has 8 colour and 1 depth images, of which 0 can be paired by name; give the two images of a"
            " frame the same name"
        ),
    ),
    Case(
        "images in too many folders",
        all_of(use_files(images() | {"rgb_right/0.png": png(colour(0))}), add_options("--fps", "10")),
        Fails(
            "{root}/take: has too many image folders (rgb, rgb_right, depth); keep one folder of colour and one"
            " of depth images"
        ),
    ),
]
