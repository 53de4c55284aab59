"""Cameras: ``camera.yaml``, ``K.txt``, ``--camera``."""

from __future__ import annotations

from helpers.corpus.base import CAMERA, FOCAL, HEIGHT, SCALE, WIDTH
from helpers.corpus.case import Case, Make, Right, Says, all_of, edit, options, remove, replaced, write

YAML = "camera.yaml"
NUMBERS = f"{FOCAL} {FOCAL} {(WIDTH - 1) / 2} {(HEIGHT - 1) / 2} {SCALE} {WIDTH} {HEIGHT}\n"


def field(name: str, value: str) -> Make:
    """Give a field of the camera another value."""
    lines = [f"{name}: {value}" if line.startswith(f"{name}:") else line for line in CAMERA.splitlines()]
    return write(YAML, "\n".join(lines) + "\n")


def numbers(text: str) -> Make:
    """A K.txt instead of the YAML file."""
    return all_of(remove(YAML), write("K.txt", text))


def bomb() -> str:
    """Anchors that multiply: a list of 10^9 in a few lines."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]" for i in range(1, 9)]
    return "\n".join(lines) + "\n"


CASES = [
    Case(
        "no camera",
        remove(YAML),
        Says(
            "{seq}: says nothing about its camera; put a camera.yaml there (fx, fy, cx, cy, width, height,"
            " depth_scale) or give --camera with a file or one of d435i, tum_fr1, tum_fr2, tum_fr3"
        ),
    ),
    Case(
        "empty file",
        write(YAML, ""),
        Says("{seq}/camera.yaml: holds no camera; write fx, fy, cx, cy, width, height, depth_scale as keys"),
    ),
    Case("broken YAML", write(YAML, "fx: {525.0\n"), Says("{seq}/camera.yaml: is not valid YAML (...); repair it")),
    Case(
        "YAML that runs a command",
        write(YAML, "!!python/object/apply:os.system ['touch /tmp/owned']\n"),
        Says("{seq}/camera.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "YAML that multiplies",
        write(YAML, bomb() + "fx: *a8\n"),
        Says("{seq}/camera.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "YAML with an anchor",
        write(YAML, CAMERA.replace(f"fx: {FOCAL}", f"fx: &f {FOCAL}").replace(f"fy: {FOCAL}", "fy: *f")),
        Says("{seq}/camera.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "YAML with a date that is none",
        field("fx", "2024-99-99"),
        Says("{seq}/camera.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "YAML nested a thousand times",
        write(YAML, 3000 * "[" + 3000 * "]"),
        Says("{seq}/camera.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "a list",
        write(YAML, "- 525.0\n- 525.0\n"),
        Says("{seq}/camera.yaml: holds no camera; write fx, fy, cx, cy, width, height, depth_scale as keys"),
    ),
    Case(
        "a field is missing",
        edit(YAML, replaced("fy:", "#fy:")),
        Says(
            "{seq}/camera.yaml: fy: field required, got {'cx': 39.5, 'cy': 29.5, 'depth_scale': 5000, 'fx':"
            " 64.0, ...}; correct the camera"
        ),
    ),
    Case(
        "a field twice",
        edit(YAML, lambda content: content + b"fx: 100\n"),
        Says("{seq}/camera.yaml: is not valid YAML (...); repair it"),
    ),
    Case(
        "an unknown field",
        edit(YAML, lambda content: content + b"focal: 525\n"),
        Says("{seq}/camera.yaml: focal: extra inputs are not permitted, got 525; correct the camera"),
    ),
    Case(
        "a word for a number",
        field("cx", "middle"),
        Says(
            "{seq}/camera.yaml: cx: input should be a valid number, unable to parse string as a number, got"
            " 'middle'; correct the camera"
        ),
    ),
    Case(
        "negative focal length",
        field("fx", "-525"),
        Says("{seq}/camera.yaml: fx: input should be greater than or equal to 1, got -525; correct the camera"),
    ),
    Case(
        "zero focal length",
        field("fy", "0"),
        Says("{seq}/camera.yaml: fy: input should be greater than or equal to 1, got 0; correct the camera"),
    ),
    Case(
        "focal length that is not a number",
        field("fx", ".nan"),
        Says("{seq}/camera.yaml: fx: input should be a finite number, got nan; correct the camera"),
    ),
    Case(
        "next to no focal length",
        field("fx", "1e-30"),
        Says("{seq}/camera.yaml: fx: input should be greater than or equal to 1, got '1e-30'; correct the camera"),
    ),
    Case(
        "endless focal length",
        field("fx", "1e300"),
        Says("{seq}/camera.yaml: fx: input should be less than or equal to 1000000, got '1e300'; correct the camera"),
    ),
    Case(
        "infinite centre",
        field("cy", ".inf"),
        Says("{seq}/camera.yaml: cy: input should be a finite number, got inf; correct the camera"),
    ),
    Case(
        "centre far outside",
        field("cx", "1e6"),
        Says(
            "{seq}/camera.yaml: the centre (1e+06, 29.5) lies far outside of 80x60 pixels; correct cx and"
            " cy, or the size"
        ),
    ),
    Case(
        "zero width",
        field("width", "0"),
        Says("{seq}/camera.yaml: width: input should be greater than 0, got 0; correct the camera"),
    ),
    Case(
        "half a pixel",
        field("height", "47.5"),
        Says(
            "{seq}/camera.yaml: height: input should be a valid integer, got a number with a fractional"
            " part, got 47.5; correct the camera"
        ),
    ),
    Case(
        "a billion pixels wide",
        field("width", "1000000000"),
        Says(
            "{seq}/camera.yaml: width: input should be less than or equal to 8192, got 1000000000; correct the camera"
        ),
    ),
    Case(
        "size of other images",
        field("width", "640"),
        Says(
            "{seq}/rgb/1305031102.000000.png: has 80x60 pixels, the camera 640x60; give the camera that"
            " took it with --camera"
        ),
    ),
    Case(
        "width and height swapped",
        all_of(
            write(
                YAML,
                CAMERA.replace(f"width: {WIDTH}", f"width: {HEIGHT}").replace(f"height: {HEIGHT}", f"height: {WIDTH}"),
            )
        ),
        Says(
            "{seq}/rgb/1305031102.000000.png: has 80x60 pixels, the camera 60x80; give the camera that took"
            " it with --camera"
        ),
    ),
    Case(
        "zero depth scale",
        field("depth_scale", "0"),
        Says("{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got 0; correct the camera"),
    ),
    Case(
        "negative depth scale",
        field("depth_scale", "-5000"),
        Says(
            "{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got -5000; correct the camera"
        ),
    ),
    Case(
        "next to no depth scale",
        field("depth_scale", "1e-30"),
        Says(
            "{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got '1e-30';"
            " correct the camera"
        ),
    ),
    Case(
        "metres per unit for units per metre",
        field("depth_scale", "0.0002"),
        Says(
            "{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got 0.0002; correct the camera"
        ),
    ),
    Case(
        "readout in milliseconds",
        field("readout", "33"),
        Says("{seq}/camera.yaml: readout: input should be less than or equal to 0.05, got 33; correct the camera"),
    ),
    Case(
        "lens of four numbers",
        edit(YAML, lambda content: content + b"distortion: [0.1, 0.1, 0, 0]\n"),
        Says("{seq}/camera.yaml: distortion.4: field required, got [0.1, 0.1, 0, 0]; correct the camera"),
    ),
    Case(
        "lens with NaN",
        edit(YAML, lambda content: content + b"distortion: [.nan, 0, 0, 0, 0]\n"),
        Says("{seq}/camera.yaml: distortion.0: input should be a finite number, got nan; correct the camera"),
    ),
    Case(
        "lens that bends rays back",
        edit(YAML, lambda content: content + b"distortion: [-50, 0, 0, 0, 0]\n"),
        Says(
            "{seq}: no point is seen at some corner of the image with the lens (-50.0, 0.0, 0.0, 0.0, 0.0);"
            " correct the camera's distortion (k1, k2, p1, p2, k3) or leave it out"
        ),
    ),
    Case(
        "lens that bends rays anywhere",
        edit(YAML, lambda content: content + b"distortion: [1e30, 1e30, 1e30, 1e30, 1e30]\n"),
        Says(
            "{seq}: no point is seen at some corner of the image with the lens (1e+30, 1e+30, 1e+30, 1e+30,"
            " 1e+30); correct the camera's distortion (k1, k2, p1, p2, k3) or leave it out"
        ),
    ),
    Case(
        "Latin-1",
        edit(YAML, lambda content: b"# Gr\xf6\xdfe\n" + content),
        Says("{seq}/camera.yaml: is not a UTF-8 text file; convert it to UTF-8 (a camera is a YAML file or a K.txt)"),
    ),
    Case(
        "byte order mark and Windows line ends",
        edit(YAML, lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n")),
        Right(),
    ),
    Case("K.txt", numbers(NUMBERS), Right()),
    Case(
        "K.txt with commas, comments, mark", numbers("\ufeff# fx, fy ...\r\n" + NUMBERS.replace(" ", ",\r\n")), Right()
    ),
    Case(
        "K.txt empty",
        numbers(""),
        Says(
            "{seq}/K.txt: holds 0 numbers that are no camera; write fx fy cx cy depth_scale width height,"
            " or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with three numbers",
        numbers("525 319.5 239.5\n"),
        Says(
            "{seq}/K.txt: holds 3 numbers that are no camera; write fx fy cx cy depth_scale width height,"
            " or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with eight numbers",
        numbers(NUMBERS + "1\n"),
        Says(
            "{seq}/K.txt: holds 8 numbers that are no camera; write fx fy cx cy depth_scale width height,"
            " or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with words",
        numbers("fx=525 fy=525\n"),
        Says(
            "{seq}/K.txt: holds something that is not a number (could not convert string to float:"
            " 'fx=525'); write fx fy cx cy depth_scale width height"
        ),
    ),
    Case(
        "K.txt with NaN",
        numbers(NUMBERS.replace(f"{FOCAL} ", "nan ", 1)),
        Says("{seq}/K.txt: fx: input should be a finite number, got nan; correct the camera"),
    ),
    Case(
        "K.txt with zero focal length",
        numbers(NUMBERS.replace(f"{FOCAL} ", "0 ", 1)),
        Says("{seq}/K.txt: fx: input should be greater than or equal to 1, got 0.0; correct the camera"),
    ),
    Case(
        "K.txt with half a pixel",
        numbers(NUMBERS.replace(f" {WIDTH} ", f" {WIDTH}.5 ")),
        Says(
            "{seq}/K.txt: width: input should be a valid integer, got a number with a fractional part, got"
            " 80.5; correct the camera"
        ),
    ),
    Case(
        "K.txt as a matrix, of 640x480 pixels",
        numbers("525 0 319.5\n0 525 239.5\n0 0 1\n"),
        Says(
            "{seq}/rgb/1305031102.000000.png: has 80x60 pixels, the camera 640x480; give the camera that"
            " took it with --camera"
        ),
    ),
    Case(
        "K.txt as a matrix with skew",
        numbers("525 3 319.5\n0 525 239.5\n0 0 1\n"),
        Says(
            "{seq}/K.txt: holds 9 numbers that are no camera; write fx fy cx cy depth_scale width height,"
            " or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with a number of 5000 digits",
        numbers(5000 * "1"),
        Says(
            "{seq}/K.txt: holds 1 numbers that are no camera; write fx fy cx cy depth_scale width height,"
            " or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "--camera that is nothing",
        options("--camera", "kinect"),
        Says("kinect: is neither a camera file nor a preset; the presets are d435i, tum_fr1, tum_fr2, tum_fr3"),
    ),
    Case(
        "--camera nearly right",
        options("--camera", "tum_f3"),
        Says("tum_f3: is neither a camera file nor a preset; did you mean tum_fr3?"),
    ),
    Case(
        "--camera of other images",
        options("--camera", "tum_fr3"),
        Says(
            "{seq}/rgb/1305031102.000000.png: has 80x60 pixels, the camera 640x480; give the camera that"
            " took it with --camera"
        ),
    ),
    Case(
        "--camera is a folder",
        options("--camera", "{seq}"),
        Says("{seq}: is neither a camera file nor a preset; the presets are d435i, tum_fr1, tum_fr2, tum_fr3"),
    ),
    Case(
        "--camera is an image",
        options("--camera", "{seq}/rgb/1305031102.000000.png"),
        Says(
            "{seq}/rgb/1305031102.000000.png: is not a UTF-8 text file; convert it to UTF-8 (a camera is"
            " a YAML file or a K.txt)"
        ),
    ),
    Case(
        "--camera instead of a broken file",
        all_of(write(YAML, "?"), write("other.yaml", CAMERA), options("--camera", "{seq}/other.yaml")),
        Right(),
    ),
]
