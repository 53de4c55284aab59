"""Invalid cameras: ``camera.yaml``, ``K.txt``, ``--camera``."""

from __future__ import annotations

from helpers.corpus.base import CAMERA, FOCAL, HEIGHT, SCALE, WIDTH
from helpers.corpus.case import Case, Damage, Fails, Succeeds, add_options, all_of, edit, remove, replace_text, write

YAML = "camera.yaml"
NUMBERS = f"{FOCAL} {FOCAL} {(WIDTH - 1) / 2} {(HEIGHT - 1) / 2} {SCALE} {WIDTH} {HEIGHT}\n"


def field(name: str, value: str) -> Damage:
    """Set a field of ``camera.yaml``."""
    lines = [f"{name}: {value}" if line.startswith(f"{name}:") else line for line in CAMERA.splitlines()]
    return write(YAML, "\n".join(lines) + "\n")


def numbers(text: str) -> Damage:
    """Replace ``camera.yaml`` by a ``K.txt``."""
    return all_of(remove(YAML), write("K.txt", text))


def bomb() -> str:
    """YAML with nested aliases: a few lines that expand to 10^9 elements."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]" for i in range(1, 9)]
    return "\n".join(lines) + "\n"


NO_CAMERA = "{seq}/camera.yaml: does not contain a camera; write fx, fy, cx, cy, width, height, depth_scale as keys"
INVALID_YAML = "{seq}/camera.yaml: is not valid YAML (...); repair it"

CASES = [
    Case(
        "missing camera file",
        remove(YAML),
        Fails(
            "{seq}: has no camera parameters; add a camera.yaml (fx, fy, cx, cy, width, height, depth_scale) or"
            " pass --camera with a file or one of d435i, tum_fr1, tum_fr2, tum_fr3"
        ),
    ),
    Case(
        "empty file",
        write(YAML, ""),
        Fails(NO_CAMERA),
    ),
    Case("invalid YAML", write(YAML, "fx: {525.0\n"), Fails(INVALID_YAML)),
    Case(
        "YAML that runs a command",
        write(YAML, "!!python/object/apply:os.system ['touch /tmp/owned']\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "YAML with nested aliases",
        write(YAML, bomb() + "fx: *a8\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "YAML with an anchor",
        write(YAML, CAMERA.replace(f"fx: {FOCAL}", f"fx: &f {FOCAL}").replace(f"fy: {FOCAL}", "fy: *f")),
        Fails(INVALID_YAML),
    ),
    Case(
        "YAML with an invalid date",
        field("fx", "2024-99-99"),
        Fails(INVALID_YAML),
    ),
    Case(
        "deeply nested YAML",
        write(YAML, 3000 * "[" + 3000 * "]"),
        Fails(INVALID_YAML),
    ),
    Case(
        "list instead of fields",
        write(YAML, "- 525.0\n- 525.0\n"),
        Fails(NO_CAMERA),
    ),
    Case(
        "missing field",
        edit(YAML, replace_text("fy:", "#fy:")),
        Fails("{seq}/camera.yaml: fy is missing; add it to the camera"),
    ),
    Case(
        "misspelt field",
        edit(YAML, replace_text("fy:", "fY:")),
        Fails("{seq}/camera.yaml: unknown key fY; did you mean fy?"),
    ),
    Case(
        "duplicate field",
        edit(YAML, lambda content: content + b"fx: 100\n"),
        Fails(INVALID_YAML),
    ),
    Case(
        "unknown field",
        edit(YAML, lambda content: content + b"focal: 525\n"),
        Fails("{seq}/camera.yaml: unknown key focal; remove it"),
    ),
    Case(
        "word instead of a number",
        field("cx", "middle"),
        Fails(
            "{seq}/camera.yaml: cx: input should be a valid number, unable to parse string as a number, got"
            " 'middle'; correct the camera"
        ),
    ),
    Case(
        "negative focal length",
        field("fx", "-525"),
        Fails("{seq}/camera.yaml: fx: input should be greater than or equal to 1, got -525; correct the camera"),
    ),
    Case(
        "zero focal length",
        field("fy", "0"),
        Fails("{seq}/camera.yaml: fy: input should be greater than or equal to 1, got 0; correct the camera"),
    ),
    Case(
        "focal length NaN",
        field("fx", ".nan"),
        Fails("{seq}/camera.yaml: fx: input should be a finite number, got nan; correct the camera"),
    ),
    Case(
        "tiny focal length",
        field("fx", "1e-30"),
        Fails("{seq}/camera.yaml: fx: input should be greater than or equal to 1, got '1e-30'; correct the camera"),
    ),
    Case(
        "huge focal length",
        field("fx", "1e300"),
        Fails("{seq}/camera.yaml: fx: input should be less than or equal to 1000000, got '1e300'; correct the camera"),
    ),
    Case(
        "infinite principal point",
        field("cy", ".inf"),
        Fails("{seq}/camera.yaml: cy: input should be a finite number, got inf; correct the camera"),
    ),
    Case(
        "principal point far outside the image",
        field("cx", "1e6"),
        Fails(
            "{seq}/camera.yaml: the principal point (1e+06, 47.5) is far outside the 128x96 image; correct cx"
            " and cy, or width and height"
        ),
    ),
    Case(
        "zero width",
        field("width", "0"),
        Fails("{seq}/camera.yaml: width: input should be greater than 0, got 0; correct the camera"),
    ),
    Case(
        "fractional height",
        field("height", "47.5"),
        Fails(
            "{seq}/camera.yaml: height: input should be a valid integer, got a number with a fractional"
            " part, got 47.5; correct the camera"
        ),
    ),
    Case(
        "width of a billion pixels",
        field("width", "1000000000"),
        Fails(
            "{seq}/camera.yaml: width: input should be less than or equal to 8192, got 1000000000; correct the camera"
        ),
    ),
    Case(
        "size of a different camera",
        field("width", "640"),
        Fails(
            "{seq}/rgb/1305031102.000000.png: has 128x96 pixels, but the camera has 640x96; pass the camera of"
            " these images with --camera"
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
        Fails(
            "{seq}/rgb/1305031102.000000.png: has 128x96 pixels, but the camera has 96x128; pass the camera of"
            " these images with --camera"
        ),
    ),
    Case(
        "zero depth scale",
        field("depth_scale", "0"),
        Fails("{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got 0; correct the camera"),
    ),
    Case(
        "negative depth scale",
        field("depth_scale", "-5000"),
        Fails(
            "{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got -5000; correct the camera"
        ),
    ),
    Case(
        "tiny depth scale",
        field("depth_scale", "1e-30"),
        Fails(
            "{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got '1e-30';"
            " correct the camera"
        ),
    ),
    Case(
        "depth scale in metres per unit",
        field("depth_scale", "0.0002"),
        Fails(
            "{seq}/camera.yaml: depth_scale: input should be greater than or equal to 1, got 0.0002; correct the camera"
        ),
    ),
    Case(
        "readout in milliseconds",
        field("readout", "33"),
        Fails("{seq}/camera.yaml: readout: input should be less than or equal to 0.05, got 33; correct the camera"),
    ),
    Case(
        "distortion with four numbers",
        edit(YAML, lambda content: content + b"distortion: [0.1, 0.1, 0, 0]\n"),
        Fails(
            "{seq}/camera.yaml: distortion has 4 numbers; write k1, k2, p1, p2, k3, or state distortion_model: one of"
            " plumb_bob, rational_polynomial, equidistant"
        ),
    ),
    Case(
        "distortion with NaN",
        edit(YAML, lambda content: content + b"distortion: [.nan, 0, 0, 0, 0]\n"),
        Fails("{seq}/camera.yaml: distortion.0: input should be a finite number, got nan; correct the camera"),
    ),
    Case(
        "distortion that cannot be inverted",
        edit(YAML, lambda content: content + b"distortion: [-50, 0, 0, 0, 0]\n"),
        Fails(
            "{seq}/camera.yaml: the distortion (-50.0, 0.0, 0.0, 0.0, 0.0) cannot be inverted at the image corners;"
            " correct the camera's distortion (k1, k2, p1, p2, k3) or remove it"
        ),
    ),
    Case(
        "huge distortion",
        edit(YAML, lambda content: content + b"distortion: [1e30, 1e30, 1e30, 1e30, 1e30]\n"),
        Fails(
            "{seq}/camera.yaml: the distortion (1e+30, 1e+30, 1e+30, 1e+30, 1e+30) cannot be inverted at the image"
            " corners; correct the camera's distortion (k1, k2, p1, p2, k3) or remove it"
        ),
    ),
    Case(
        "Latin-1",
        edit(YAML, lambda content: b"# Gr\xf6\xdfe\n" + content),
        Fails("{seq}/camera.yaml: is not a UTF-8 text file; convert it to UTF-8 (a camera is a YAML file or a K.txt)"),
    ),
    Case(
        "byte order mark and Windows line endings",
        edit(YAML, lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n")),
        Succeeds(),
    ),
    Case("K.txt", numbers(NUMBERS), Succeeds()),
    Case(
        "K.txt with commas, comments and byte order mark",
        numbers("\ufeff# fx, fy ...\r\n" + NUMBERS.replace(" ", ",\r\n")),
        Succeeds(),
    ),
    Case(
        "empty K.txt",
        numbers(""),
        Fails(
            "{seq}/K.txt: contains 0 numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with three numbers",
        numbers("525 319.5 239.5\n"),
        Fails(
            "{seq}/K.txt: contains 3 numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with eight numbers",
        numbers(NUMBERS + "1\n"),
        Fails(
            "{seq}/K.txt: contains 8 numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with words",
        numbers("fx=525 fy=525\n"),
        Fails(
            "{seq}/K.txt: contains a value that is not a number (could not convert string to float: 'fx=525');"
            " write fx fy cx cy depth_scale width height"
        ),
    ),
    Case(
        "K.txt with NaN",
        numbers(NUMBERS.replace(f"{FOCAL} ", "nan ", 1)),
        Fails("{seq}/K.txt: fx: input should be a finite number, got nan; correct the camera"),
    ),
    Case(
        "K.txt with zero focal length",
        numbers(NUMBERS.replace(f"{FOCAL} ", "0 ", 1)),
        Fails("{seq}/K.txt: fx: input should be greater than or equal to 1, got 0.0; correct the camera"),
    ),
    Case(
        "K.txt with a fractional width",
        numbers(NUMBERS.replace(f" {WIDTH} ", f" {WIDTH}.5 ")),
        Fails(
            "{seq}/K.txt: width: input should be a valid integer, got a number with a fractional part, got"
            " 128.5; correct the camera"
        ),
    ),
    Case(
        "K.txt with a matrix, for 640x480 pixels",
        numbers("525 0 319.5\n0 525 239.5\n0 0 1\n"),
        Fails(
            "{seq}/K.txt: the principal point (319.5, 239.5) is far outside the 128x96 image; correct cx and cy, or"
            " width and height"
        ),
    ),
    Case(
        "K.txt with a matrix with skew",
        numbers("525 3 319.5\n0 525 239.5\n0 0 1\n"),
        Fails(
            "{seq}/K.txt: contains 9 numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "K.txt with a number of 5000 digits",
        numbers(5000 * "1"),
        Fails(
            "{seq}/K.txt: contains 1 numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        ),
    ),
    Case(
        "--camera unknown",
        add_options("--camera", "kinect"),
        Fails("kinect: is not a camera file or preset; the presets are d435i, tum_fr1, tum_fr2, tum_fr3"),
    ),
    Case(
        "--camera misspelled",
        add_options("--camera", "tum_f3"),
        Fails("tum_f3: is not a camera file or preset; did you mean tum_fr3?"),
    ),
    Case(
        "--camera with another image size",
        add_options("--camera", "tum_fr3"),
        Fails(
            "{seq}/rgb/1305031102.000000.png: has 128x96 pixels, but the camera has 640x480; pass the camera of"
            " these images with --camera"
        ),
    ),
    Case(
        "--camera is a folder",
        add_options("--camera", "{seq}"),
        Fails("{seq}: is not a camera file or preset; the presets are d435i, tum_fr1, tum_fr2, tum_fr3"),
    ),
    Case(
        "--camera is an image",
        add_options("--camera", "{seq}/rgb/1305031102.000000.png"),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is not a UTF-8 text file; convert it to UTF-8 (a camera is"
            " a YAML file or a K.txt)"
        ),
    ),
    Case(
        "--camera instead of an invalid file",
        all_of(write(YAML, "?"), write("other.yaml", CAMERA), add_options("--camera", "{seq}/other.yaml")),
        Succeeds(),
    ),
]
