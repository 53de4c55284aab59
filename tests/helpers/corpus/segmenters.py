"""Masks and weights."""

from __future__ import annotations

import shutil

import numpy as np
from onnx import TensorProto, helper

from helpers.corpus.base import FRAMES, HEIGHT, STAMPS, WIDTH, png
from helpers.corpus.case import Case, Make, Right, Says, all_of, only, options, write

MASKS = ("--segmenter", "masks", "--masks", "{seq}/ids")


def masks(of: object, names: list[str] = STAMPS) -> Make:
    """A folder of id images, and the options for it."""
    return all_of(*(write(f"ids/{name}.png", of(i)) for i, name in enumerate(names)), only(*MASKS))


def ids(value: int, share: float = 0.25, kind: type = np.uint8) -> bytes:
    """An id image with an instance on the left."""
    image = np.zeros((HEIGHT, WIDTH), kind)
    image[:, : int(share * WIDTH)] = value
    return png(image)


def network(file: str, inputs: list[int | str], nodes: object = None) -> Make:
    """An ONNX network that passes on what it is given."""
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
    """An ONNX network with the outputs of a segmentation head, all of one value."""
    height, width = 64, 96
    count = cells or sum(height * width // stride**2 for stride in (8, 16, 32))
    shapes = {"output0": [1, 116, count], "output1": [1, 32, height // 4, width // 4]}
    info = helper.make_tensor_value_info
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
        [info("images", TensorProto.FLOAT, [1, 3, height, width])],
        [info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return all_of(write("own.onnx", model.SerializeToString()), only("--weights", "{seq}/own.onnx"))


CASES = [
    Case("masks of a person", masks(lambda i: ids(1)), Right()),
    Case("masks without a person", masks(lambda i: ids(0)), Right()),
    Case("masks of 16 bits", masks(lambda i: ids(1000, kind=np.uint16)), Right()),
    Case("masks named by number", masks(lambda i: ids(1), [f"{i:06d}" for i in range(FRAMES)]), Right()),
    Case(
        "only people",
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
        "too few masks by number",
        masks(lambda i: ids(1), ["0", "1", "2"]),
        Says(
            "{seq}/ids: has no id image for frame 3 at 1305031102.300000 s; add it, or name the folder that"
            " belongs to this sequence (the results of the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "masks of another time",
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
            "{seq}/ids/1305031102.000000.png: has 3 channels, an id image has one of 8 or 16 bit; write it"
            " so (the results of the 0 frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "a mask breaks off",
        masks(lambda i: ids(1)[: 60 if i == 3 else None]),
        Says(
            "{seq}/ids/1305031102.300000.png: cannot be read as an image; write it again (the results of"
            " the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "a mask that is no image",
        masks(lambda i: b"masks" if i == 3 else ids(1)),
        Says(
            "{seq}/ids/1305031102.300000.png: cannot be read as an image; write it again (the results of"
            " the 3 frames before are in {out}; go on with --resume {out})",
            kept=3,
        ),
    ),
    Case(
        "depth images for masks",
        masks(lambda i: png(np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH))),
        Says(
            "{seq}/ids/1305031102.000000.png: has 4799 different values; an id image has one for each"
            " instance and 0 for the rest, name the folder of such images with --masks (the results of the 0"
            " frames before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "no folder of masks",
        only("--segmenter", "masks"),
        Says("segmentation.source=masks: name the folder of the id images with --masks"),
    ),
    Case(
        "a folder that is not there",
        only("--masks", "{root}/none"),
        Says("{root}/none: holds no PNG files; name the folder of the id images with --masks"),
    ),
    Case(
        "a file for the folder of masks",
        only("--masks", "{seq}/rgb.txt"),
        Says("{seq}/rgb.txt: holds no PNG files; name the folder of the id images with --masks"),
    ),
    Case(
        "--masks with --segmenter none",
        options("--masks", "{seq}/rgb"),
        Says("--masks {seq}/rgb: means nothing to segmentation.source=none; leave it out, or give --segmenter masks"),
    ),
    Case(
        "--masks with --segmenter yolo",
        only("--segmenter", "yolo", "--masks", "{seq}/rgb"),
        Says("--masks {seq}/rgb: means nothing to segmentation.source=yolo; leave it out, or give --segmenter masks"),
    ),
    Case(
        "--weights with --segmenter none",
        options("--weights", "{seq}/none.onnx"),
        Says(
            "--weights {seq}/none.onnx: means nothing to segmentation.source=none; leave it out, or give"
            " --segmenter yolo"
        ),
    ),
    Case(
        "--weights with masks",
        all_of(masks(lambda i: ids(1)), options("--weights", "own.onnx")),
        Says("--weights own.onnx: means nothing to segmentation.source=masks; leave it out, or give --segmenter yolo"),
    ),
    Case(
        "weights that are not there",
        only("--weights", "{root}/none.onnx"),
        Says("{root}/none.onnx: there is no such file; check the path given as --weights"),
    ),
    Case(
        "a checkpoint that is not there",
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
        Says("{seq}/own.onnx: onnxruntime cannot open it; delete the file or export it again"),
    ),
    Case(
        "ONNX that is empty",
        all_of(write("own.onnx", ""), only("--weights", "{seq}/own.onnx")),
        Says("{seq}/own.onnx: onnxruntime cannot open it; delete the file or export it again"),
    ),
    Case(
        "ONNX of another network",
        network("own.onnx", [1, 3, 224, 224]),
        Says(
            "{seq}/own.onnx: is not a raw segmentation head with one float input (1, 3, H, W), H and W"
            " fixed multiples of 32, and outputs (1, 116, N) and (1, 32, H/4, W/4), but maps"
            " [('tensor(float)', [1, 3, 224, 224])] to [('tensor(float)', [1, 3, 224, 224])]; export it with"
            " a fixed size and without NMS"
        ),
    ),
    Case(
        "ONNX of free size",
        network("own.onnx", [1, 3, "height", "width"]),
        Says(
            "{seq}/own.onnx: is not a raw segmentation head with one float input (1, 3, H, W), H and W"
            " fixed multiples of 32, and outputs (1, 116, N) and (1, 32, H/4, W/4), but maps"
            " [('tensor(float)', [1, 3, 'height', 'width'])] to [('tensor(float)', [1, 3, 'height',"
            " 'width'])]; export it with a fixed size and without NMS"
        ),
    ),
    Case("ONNX that sees nothing", head(0.0), Right()),
    Case(
        "ONNX that gives NaN",
        head(float("nan")),
        Says(
            "{seq}/own.onnx: gives what is no number; train or export it again (the results of the 0 frames"
            " before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "ONNX that gives infinity",
        head(float("inf")),
        Says(
            "{seq}/own.onnx: gives what is no number; train or export it again (the results of the 0 frames"
            " before are in {out})",
            kept=0,
        ),
    ),
    Case(
        "a checkpoint with another checksum",
        all_of(write("own.pt", b"PK\x03\x04" + bytes(1000)), only("--weights", "{seq}/own.pt")),
        Says(
            "{seq}/own.pt: is not the published yolov8n-seg.pt (its sha256 is"
            " 586505ce151936969221b2baf9b898055e1f13ea0316557a8e9b4ac4f9c1dea0); weights of your own go in"
            " as an .onnx export"
        ),
    ),
]
