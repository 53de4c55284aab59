"""Cases with id images and weights of the segmentation network."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import numpy as np
from onnx import TensorProto, helper

from helpers.corpus.base import FRAMES, HEIGHT, STAMPS, WIDTH, png
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    add_options,
    all_of,
    fails_after_run,
    fails_at_frame,
    replace_options,
    write,
)

MASKS = ("--segmenter", "masks", "--masks", "{seq}/ids")


def masks(make_image: Callable[[int], bytes], names: list[str] = STAMPS) -> Damage:
    """Write a folder of id images, made from their indices, and use it."""
    return all_of(*(write(f"ids/{name}.png", make_image(i)) for i, name in enumerate(names)), replace_options(*MASKS))


def ids(value: int, width_fraction: float = 0.25, dtype: type = np.uint8) -> bytes:
    """Id image with one instance on the left, as PNG."""
    image = np.zeros((HEIGHT, WIDTH), dtype)
    image[:, : int(width_fraction * WIDTH)] = value
    return png(image)


def network(file: str, inputs: list[int | str]) -> Damage:
    """Write an ONNX network that returns its input, and use it."""
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        [helper.make_node("Identity", ["images"], ["output0"])],
        "g",
        [value("images", TensorProto.FLOAT, inputs)],
        [value("output0", TensorProto.FLOAT, inputs)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return all_of(write(file, model.SerializeToString()), replace_options("--weights", "{seq}/" + file))


def head(value: float, cells: int | None = None) -> Damage:
    """Write an ONNX network with constant outputs in the shapes of a segmentation head, and use it."""
    height, width = 64, 96
    count = cells or sum(height * width // stride**2 for stride in (8, 16, 32))
    shapes = {"output0": [1, 116, count], "output1": [1, 32, height // 4, width // 4]}
    value_info = helper.make_tensor_value_info
    nodes = []
    for name, shape in shapes.items():
        fill = helper.make_tensor("value", TensorProto.FLOAT, [1], [value])
        size = helper.make_tensor("size", TensorProto.INT64, [len(shape)], shape)
        nodes += [
            helper.make_node("Constant", [], [f"{name}_size"], value=size),
            helper.make_node("ConstantOfShape", [f"{name}_size"], [name], value=fill),
        ]
    graph = helper.make_graph(
        nodes,
        "g",
        [value_info("images", TensorProto.FLOAT, [1, 3, height, width])],
        [value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return all_of(write("own.onnx", model.SerializeToString()), replace_options("--weights", "{seq}/own.onnx"))


CASES = [
    Case("masks of a person", masks(lambda i: ids(1)), Succeeds()),
    Case("masks without a person", masks(lambda i: ids(0)), Succeeds()),
    Case("16-bit id images", masks(lambda i: ids(1000, dtype=np.uint16)), Succeeds()),
    Case("masks named by number", masks(lambda i: ids(1), [f"{i:06d}" for i in range(FRAMES)]), Succeeds()),
    Case(
        "people in the whole image",
        masks(lambda i: ids(1, 1.0)),
        fails_after_run(
            "seq: the camera was not found in any of the 8 frames, masked objects cover the images; see"
            " figures/masks.png, and try --segmenter none"
        ),
    ),
    Case(
        "a mask for every other frame",
        masks(lambda i: ids(1), STAMPS[::2]),
        Fails(
            "{seq}/ids: has no id image for 4 of 8 frames, the first of them frame 1 at 1305031102.100000 s; add it, or"
            " name the folder that belongs to this sequence"
        ),
    ),
    Case(
        "too few numbered id images",
        masks(lambda i: ids(1), ["0", "1", "2"]),
        Fails(
            f"{{seq}}/ids: has 3 id images for {FRAMES} frames, and their names are not timestamps; name each one by"
            " the timestamp of its frame, or write one for each frame"
        ),
    ),
    Case(
        "id images of another time",
        masks(lambda i: ids(1), [f"{i}.5" for i in range(FRAMES)]),
        Fails(
            "{seq}/ids: has no id image for 8 of 8 frames, the first of them frame 0 at 1305031102.000000 s; add it, or"
            " name the folder that belongs to this sequence"
        ),
    ),
    Case(
        "masks of another size",
        masks(lambda i: png(np.zeros((HEIGHT * 2, WIDTH * 2), np.uint8))),
        fails_at_frame(
            0,
            "{seq}/ids/1305031102.000000.png: has 256x192 pixels, its frame 128x96; write id images of the size"
            " of the frames",
        ),
    ),
    Case(
        "masks in colour",
        masks(lambda i: png(np.zeros((HEIGHT, WIDTH, 3), np.uint8))),
        fails_at_frame(
            0,
            "{seq}/ids/1305031102.000000.png: has 3 channels, expected one 8- or 16-bit channel; write it with"
            " one channel",
        ),
    ),
    Case(
        "a truncated id image",
        masks(lambda i: ids(1)[: 60 if i == 3 else None]),
        fails_at_frame(3, "{seq}/ids/1305031102.300000.png: is not a readable PNG image; write it again"),
    ),
    Case(
        "an id image that is not an image",
        masks(lambda i: b"masks" if i == 3 else ids(1)),
        fails_at_frame(3, "{seq}/ids/1305031102.300000.png: is not a readable PNG image; write it again"),
    ),
    Case(
        "depth images in place of id images",
        masks(lambda i: png(np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH))),
        fails_at_frame(
            0,
            "{seq}/ids/1305031102.000000.png: has 12287 different ids, more than 255; an id image has one value"
            " for each instance and 0 for the background, name the folder of such images with --masks",
        ),
    ),
    Case(
        "no folder of masks",
        replace_options("--segmenter", "masks"),
        Fails("segmentation.source=masks: the folder of the id images is missing; only `run` takes one, with --masks"),
    ),
    Case(
        "a missing folder of id images",
        replace_options("--masks", "{root}/none"),
        Fails("{root}/none: does not exist; name the folder of the id images with --masks"),
    ),
    Case(
        "a file in place of the folder of id images",
        replace_options("--masks", "{seq}/rgb.txt"),
        Fails("{seq}/rgb.txt: contains no PNG files; name the folder of the id images with --masks"),
    ),
    Case(
        "--masks with --segmenter none",
        add_options("--masks", "{seq}/rgb"),
        Fails("--masks {seq}/rgb: not used with segmentation.source=none; remove it, or add --segmenter masks"),
    ),
    Case(
        "--masks with --segmenter yolo",
        replace_options("--segmenter", "yolo", "--masks", "{seq}/rgb"),
        Fails("--masks {seq}/rgb: not used with segmentation.source=yolo; remove it, or add --segmenter masks"),
    ),
    Case(
        "--weights with --segmenter none",
        add_options("--weights", "{seq}/none.onnx"),
        Fails("--weights {seq}/none.onnx: not used with segmentation.source=none; remove it, or add --segmenter yolo"),
    ),
    Case(
        "--weights with masks",
        all_of(masks(lambda i: ids(1)), add_options("--weights", "own.onnx")),
        Fails("--weights own.onnx: not used with segmentation.source=masks; remove it, or add --segmenter yolo"),
    ),
    Case(
        "a missing ONNX file",
        replace_options("--weights", "{root}/none.onnx"),
        Fails("{root}/none.onnx: no such file; check the path given with --weights"),
    ),
    Case(
        "a missing .pt file",
        replace_options("--weights", "{root}/none.pt"),
        Fails("{root}/none.pt: cannot be read (No such file or directory); check the path of the weights"),
    ),
    Case(
        "weights are a folder",
        replace_options("--weights", "{seq}"),
        Fails("{seq}: cannot be read (Is a directory); check the path of the weights"),
    ),
    Case(
        "ONNX that is an image",
        all_of(
            lambda p: shutil.copy(p.folder / f"rgb/{STAMPS[0]}.png", p.folder / "own.onnx"),
            replace_options("--weights", "{seq}/own.onnx"),
        ),
        Fails("{seq}/own.onnx: is not a network that onnxruntime can load; delete the file or export it again"),
    ),
    Case(
        "ONNX that is empty",
        all_of(write("own.onnx", ""), replace_options("--weights", "{seq}/own.onnx")),
        Fails("{seq}/own.onnx: is not a network that onnxruntime can load; delete the file or export it again"),
    ),
    Case(
        "ONNX of another network",
        network("own.onnx", [1, 3, 224, 224]),
        Fails(
            "{seq}/own.onnx: is not a raw segmentation head with one float input (1, 3, H, W), H and W"
            " fixed multiples of 32, and outputs (1, 116, N) and (1, 32, H/4, W/4): it maps"
            " [('tensor(float)', [1, 3, 224, 224])] to [('tensor(float)', [1, 3, 224, 224])]; export it with"
            " a fixed size and without NMS"
        ),
    ),
    Case(
        "ONNX of variable size",
        network("own.onnx", [1, 3, "height", "width"]),
        Fails(
            "{seq}/own.onnx: is not a raw segmentation head with one float input (1, 3, H, W), H and W"
            " fixed multiples of 32, and outputs (1, 116, N) and (1, 32, H/4, W/4): it maps"
            " [('tensor(float)', [1, 3, 'height', 'width'])] to [('tensor(float)', [1, 3, 'height',"
            " 'width'])]; export it with a fixed size and without NMS"
        ),
    ),
    Case("ONNX that detects nothing", head(0.0), Succeeds()),
    Case(
        "ONNX with NaN in its output",
        head(float("nan")),
        fails_at_frame(0, "{seq}/own.onnx: network output contains NaN or infinity; train or export it again"),
    ),
    Case(
        "ONNX with infinity in its output",
        head(float("inf")),
        fails_at_frame(0, "{seq}/own.onnx: network output contains NaN or infinity; train or export it again"),
    ),
    Case(
        "a .pt file with another checksum",
        all_of(write("own.pt", b"PK\x03\x04" + bytes(1000)), replace_options("--weights", "{seq}/own.pt")),
        Fails(
            "{seq}/own.pt: is not the published yolov8n-seg.pt (its sha256 is"
            " 586505ce151936969221b2baf9b898055e1f13ea0316557a8e9b4ac4f9c1dea0); give weights of your own"
            " as an .onnx file"
        ),
    ),
]
