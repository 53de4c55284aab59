"""Cases with id images and weights of the segmentation network."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import numpy as np
from onnx import TensorProto, helper

from helpers.corpus.base import FRAMES, HEIGHT, STAMPS, WIDTH, png
from helpers.corpus.case import Case, Make, Right, Says, all_of, only, options, write

MASKS = ("--segmenter", "masks", "--masks", "{seq}/ids")


def masks(make_image: Callable[[int], bytes], names: list[str] = STAMPS) -> Make:
    """A folder of id images, made from their indices, and the options to use it."""
    return all_of(*(write(f"ids/{name}.png", make_image(i)) for i, name in enumerate(names)), only(*MASKS))


def ids(value: int, width_fraction: float = 0.25, dtype: type = np.uint8) -> bytes:
    """An id image with one instance on the left, as PNG."""
    image = np.zeros((HEIGHT, WIDTH), dtype)
    image[:, : int(width_fraction * WIDTH)] = value
    return png(image)


def network(file: str, inputs: list[int | str]) -> Make:
    """An ONNX network that returns its input, and the option to use it."""
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        [helper.make_node("Identity", ["images"], ["output0"])],
        "g",
        [value("images", TensorProto.FLOAT, inputs)],
        [value("output0", TensorProto.FLOAT, inputs)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return all_of(write(file, model.SerializeToString()), only("--weights", "{seq}/" + file))


def head(value: float, cells: int | None = None) -> Make:
    """An ONNX network with constant outputs of the shapes of a segmentation head, and the option to use it."""
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
    return all_of(write("own.onnx", model.SerializeToString()), only("--weights", "{seq}/own.onnx"))


CASES = [
    Case("masks of a person", masks(lambda i: ids(1)), Right()),
    Case("masks without a person", masks(lambda i: ids(0)), Right()),
    Case("16-bit id images", masks(lambda i: ids(1000, dtype=np.uint16)), Right()),
    Case("masks named by number", masks(lambda i: ids(1), [f"{i:06d}" for i in range(FRAMES)]), Right()),
    Case(
        "people in the whole image",
        masks(lambda i: ids(1, 1.0)),
        Says(
            "seq: the camera was found in none of the 8 frames, people and what else may move cover them;"
            " see figures/masks.png, and try --segmenter none (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "a mask for every other frame",
        masks(lambda i: ids(1), STAMPS[::2]),
        Says(
            "{seq}/ids: has no id image for frame 1 at 1305031102.100000 s; add it, or name the folder that"
            " belongs to this sequence (the results of the 1 frames before are in {out}; go on with --resume {out})",
            kept=1,
        ),
    ),
    Case(
        "too few numbered id images",
        masks(lambda i: ids(1), ["0", "1", "2"]),
        Says(
            "{seq}/ids: has no id image for frame 3 at 1305031102.300000 s; add it, or name the folder that"
            " belongs to this sequence (the results of the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "id images of another time",
        masks(lambda i: ids(1), [f"{i}.5" for i in range(FRAMES)]),
        Says(
            "{seq}/ids: has no id image for frame 0 at 1305031102.000000 s; add it, or name the folder that"
            " belongs to this sequence (the results of the 0 frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "masks of another size",
        masks(lambda i: png(np.zeros((HEIGHT * 2, WIDTH * 2), np.uint8))),
        Says(
            "{seq}/ids/1305031102.000000.png: has 160x120 pixels, its frame 80x60; write id images of the"
            " size of the frames (the results of the 0 frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "masks in colour",
        masks(lambda i: png(np.zeros((HEIGHT, WIDTH, 3), np.uint8))),
        Says(
            "{seq}/ids/1305031102.000000.png: has 3 channels, expected one 8- or 16-bit channel; write it"
            " with one channel (the results of the 0 frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "a truncated id image",
        masks(lambda i: ids(1)[: 60 if i == 3 else None]),
        Says(
            "{seq}/ids/1305031102.300000.png: is not a readable PNG image; write it again (the results of"
            " the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "an id image that is not an image",
        masks(lambda i: b"masks" if i == 3 else ids(1)),
        Says(
            "{seq}/ids/1305031102.300000.png: is not a readable PNG image; write it again (the results of"
            " the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "depth images in place of id images",
        masks(lambda i: png(np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH))),
        Says(
            "{seq}/ids/1305031102.000000.png: has 4799 different ids, more than 255; an id image has"
            " one value for each instance and 0 for the background, name the folder of such images with --masks (the"
            " results of the 0 frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "no folder of masks",
        only("--segmenter", "masks"),
        Says("segmentation.source=masks: the folder of the id images is missing; name it with --masks"),
    ),
    Case(
        "a missing folder of id images",
        only("--masks", "{root}/none"),
        Says("{root}/none: contains no PNG files; name the folder of the id images with --masks"),
    ),
    Case(
        "a file in place of the folder of id images",
        only("--masks", "{seq}/rgb.txt"),
        Says("{seq}/rgb.txt: contains no PNG files; name the folder of the id images with --masks"),
    ),
    Case(
        "--masks with --segmenter none",
        options("--masks", "{seq}/rgb"),
        Says("--masks {seq}/rgb: not used with segmentation.source=none; remove it, or add --segmenter masks"),
    ),
    Case(
        "--masks with --segmenter yolo",
        only("--segmenter", "yolo", "--masks", "{seq}/rgb"),
        Says("--masks {seq}/rgb: not used with segmentation.source=yolo; remove it, or add --segmenter masks"),
    ),
    Case(
        "--weights with --segmenter none",
        options("--weights", "{seq}/none.onnx"),
        Says("--weights {seq}/none.onnx: not used with segmentation.source=none; remove it, or add --segmenter yolo"),
    ),
    Case(
        "--weights with masks",
        all_of(masks(lambda i: ids(1)), options("--weights", "own.onnx")),
        Says("--weights own.onnx: not used with segmentation.source=masks; remove it, or add --segmenter yolo"),
    ),
    Case(
        "a missing ONNX file",
        only("--weights", "{root}/none.onnx"),
        Says("{root}/none.onnx: no such file; check the path given with --weights"),
    ),
    Case(
        "a missing .pt file",
        only("--weights", "{root}/none.pt"),
        Says("{root}/none.pt: cannot be read (No such file or directory); check the path of the weights"),
    ),
    Case(
        "weights are a folder",
        only("--weights", "{seq}"),
        Says("{seq}: cannot be read (Is a directory); check the path of the weights"),
    ),
    Case(
        "ONNX that is an image",
        all_of(
            lambda p: shutil.copy(p.folder / f"rgb/{STAMPS[0]}.png", p.folder / "own.onnx"),
            only("--weights", "{seq}/own.onnx"),
        ),
        Says("{seq}/own.onnx: is not a network that onnxruntime can load; delete the file or export it again"),
    ),
    Case(
        "ONNX that is empty",
        all_of(write("own.onnx", ""), only("--weights", "{seq}/own.onnx")),
        Says("{seq}/own.onnx: is not a network that onnxruntime can load; delete the file or export it again"),
    ),
    Case(
        "ONNX of another network",
        network("own.onnx", [1, 3, 224, 224]),
        Says(
            "{seq}/own.onnx: is not a raw segmentation head with one float input (1, 3, H, W), H and W"
            " fixed multiples of 32, and outputs (1, 116, N) and (1, 32, H/4, W/4): it maps"
            " [('tensor(float)', [1, 3, 224, 224])] to [('tensor(float)', [1, 3, 224, 224])]; export it with"
            " a fixed size and without NMS"
        ),
    ),
    Case(
        "ONNX of variable size",
        network("own.onnx", [1, 3, "height", "width"]),
        Says(
            "{seq}/own.onnx: is not a raw segmentation head with one float input (1, 3, H, W), H and W"
            " fixed multiples of 32, and outputs (1, 116, N) and (1, 32, H/4, W/4): it maps"
            " [('tensor(float)', [1, 3, 'height', 'width'])] to [('tensor(float)', [1, 3, 'height',"
            " 'width'])]; export it with a fixed size and without NMS"
        ),
    ),
    Case("ONNX that detects nothing", head(0.0), Right()),
    Case(
        "ONNX with NaN in its output",
        head(float("nan")),
        Says(
            "{seq}/own.onnx: network output contains NaN or infinity; train or export it again (the results of the 0"
            " frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "ONNX with infinity in its output",
        head(float("inf")),
        Says(
            "{seq}/own.onnx: network output contains NaN or infinity; train or export it again (the results of the 0"
            " frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "a .pt file with another checksum",
        all_of(write("own.pt", b"PK\x03\x04" + bytes(1000)), only("--weights", "{seq}/own.pt")),
        Says(
            "{seq}/own.pt: is not the published yolov8n-seg.pt (its sha256 is"
            " 586505ce151936969221b2baf9b898055e1f13ea0316557a8e9b4ac4f9c1dea0); give weights of your own"
            " as an .onnx file"
        ),
    ),
]
