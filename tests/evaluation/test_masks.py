"""Mask evaluation: scores against plain loops, properties, ground-truth masks from files, scores of a run."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets.base import HasMotionMasks
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import InputError
from v3d_torch.evaluation.masks import UNSURE, MaskEvaluation, count_id_switches, covering_ids, people_in_view, tally
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.results import write_results
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

H, W = 9, 11
VALUES = [0, 0, 0, 1, 2, 7, 254, 255]
"""Values of a ground-truth mask: many static pixels, some unsure."""


def random_truth(seed: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).choice(np.array(VALUES, dtype=np.uint8), (H, W)))


def random_mask(seed: int, fraction: float = 0.5) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((H, W)) < fraction)


def all_people(truth: Tensor) -> Tensor:
    return people_in_view(truth, torch.ones_like(truth, dtype=torch.bool), 1)


# --- fractions left out of tracking


@given(st.lists(st.integers(0, 10_000), min_size=1, max_size=4))
@settings(max_examples=40)
def test_fractions_equal_a_loop_over_pixels(seeds: list[int]) -> None:
    evaluation = MaskEvaluation()
    counts = {"moving": [0, 0], "static": [0, 0], "anywhere": [0, 0]}
    for stamp, seed in enumerate(seeds):
        truth, masked, measured = random_truth(seed), random_mask(seed + 1), random_mask(seed + 2, 0.7)
        evaluation.add(float(stamp), truth, measured.float()[None], masked, {})
        for v in range(H):
            for u in range(W):
                kinds = []
                if 0 < truth[v, u] < 255 and measured[v, u]:
                    kinds = ["moving"]
                elif truth[v, u] == 0:
                    kinds = ["anywhere", "static"] if measured[v, u] else ["anywhere"]
                for kind in kinds:
                    counts[kind][0] += int(masked[v, u])
                    counts[kind][1] += 1
    scores = evaluation.compute_scores()
    assert scores is not None and scores.frames == len(seeds)
    for kind, score in zip(
        counts, (scores.moving_masked, scores.static_masked, scores.static_masked_anywhere), strict=True
    ):
        assert score == (counts[kind][0] / counts[kind][1] if counts[kind][1] else None)


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_tally_of_batch_equals_tally_of_each_image(seed: int) -> None:
    masked = torch.stack([random_mask(seed + k) for k in range(6)]).reshape(2, 3, H, W)
    region = torch.stack([random_mask(seed + 6 + k) for k in range(6)]).reshape(2, 3, H, W)
    batch = tally(masked, region)
    assert batch.shape == (2, 3, 2) and batch.dtype == torch.int64
    for i in range(2):
        for j in range(3):
            assert torch.equal(batch[i, j], tally(masked[i, j], region[i, j]))


def test_convention_fractions_are_over_pixels_not_frames() -> None:
    """A frame full of people has more weight than a frame with a sleeve."""
    evaluation = MaskEvaluation()
    depth = torch.ones(1, 10, 10)
    full, corner = torch.ones(10, 10, dtype=torch.uint8), torch.zeros(10, 10, dtype=torch.uint8)
    corner[0, 0] = 1
    evaluation.add(0.0, full, depth, torch.ones(10, 10, dtype=torch.bool), {})
    evaluation.add(1.0, corner, depth, torch.zeros(10, 10, dtype=torch.bool), {})
    scores = evaluation.compute_scores()
    assert scores is not None
    assert scores.moving_masked == 100 / 101
    assert scores.static_masked == 0.0


def test_unsure_pixels_are_neither_moving_nor_static() -> None:
    evaluation = MaskEvaluation()
    truth = torch.full((10, 10), 255, dtype=torch.uint8)
    evaluation.add(0.0, truth, torch.ones(1, 10, 10), torch.ones(10, 10, dtype=torch.bool), {})
    scores = evaluation.compute_scores()
    assert scores is not None
    assert scores.moving_masked is scores.static_masked is scores.static_masked_anywhere is None
    assert scores.people == () and scores.id_switches_per_60_frames is None


def test_evaluation_without_frames_has_no_scores() -> None:
    assert MaskEvaluation().compute_scores() is None


# --- people in view, and the objects that cover them


def test_people_in_view_fill_a_fraction_of_the_whole_image_also_where_depth_is_missing() -> None:
    evaluation, truth, depth = MaskEvaluation(), torch.zeros(50, 40, dtype=torch.uint8), torch.zeros(1, 50, 40)
    depth[:, :25] = 1.0
    truth[0, :6], truth[1, :5] = 3, 4  # 0.3 % of the image are 6 pixels
    evaluation.add(0.0, truth, depth, torch.zeros(50, 40, dtype=torch.bool), {})
    scores = evaluation.compute_scores()
    assert scores is not None and [person.id for person in scores.people] == [3]


def test_people_in_view_have_enough_pixels_with_depth() -> None:
    truth = torch.zeros(4, 10, dtype=torch.uint8)
    truth[0], truth[1, :5], truth[2], truth[3] = 3, 4, 5, 255
    measured = torch.ones(4, 10, dtype=torch.bool)
    measured[2, :6] = False
    assert people_in_view(truth, measured, 5).tolist() == [3, 4]
    assert people_in_view(truth, measured, 4).tolist() == [3, 4, 5]
    assert people_in_view(truth, measured, 0).tolist() == [3, 4, 5]  # absent people are not in view


@given(st.integers(0, 10_000), st.lists(st.integers(1, 40), unique=True, max_size=6))
@settings(max_examples=80)
def test_covering_objects_equal_a_loop_over_sets_of_pixels(seed: int, ids: list[int]) -> None:
    truth = random_truth(seed)
    people = all_people(truth)
    objects = {}
    for k, id_ in enumerate(ids):  # a person's mask with noise, so that overlaps are around one half
        person = int(np.random.default_rng(seed + k).choice(VALUES[3:7]))
        objects[id_] = (truth == person) ^ random_mask(seed + k, 0.08)
    expected = []
    for person in people.tolist():
        own = {tuple(p) for p in (truth == person).nonzero().tolist()}
        best, best_overlap = 0, 0.5
        for id_, mask in objects.items():
            covered = {tuple(p) for p in (mask & (truth != UNSURE)).nonzero().tolist()}
            if (overlap := len(own & covered) / len(own | covered)) > best_overlap:
                best, best_overlap = id_, overlap
        expected.append(best)
    assert covering_ids(truth, people, objects).tolist() == expected


def test_object_over_two_people_covers_the_larger_one() -> None:
    truth = torch.zeros(10, 10, dtype=torch.uint8)
    truth[:, :6], truth[:, 6:8] = 1, 2
    assert covering_ids(truth, all_people(truth), {5: truth > 0}).tolist() == [5, 0]
    half = truth == 1
    half[:, :3] = False  # an overlap of exactly one half is not enough
    assert covering_ids(truth, all_people(truth), {5: half}).tolist() == [0, 0]
    half[0, 0] = True
    assert covering_ids(truth, all_people(truth), {5: half}).tolist() == [5, 0]


# --- id switches

VISITS = st.lists(st.tuples(st.sampled_from([0.1, 0.4, 0.7]), st.integers(0, 3)), max_size=25)
"""Seconds since the previous frame, and the id."""


def to_tensors(visits: list[tuple[float, int]]) -> tuple[Tensor, Tensor]:
    stamps = torch.tensor([gap for gap, _ in visits], dtype=torch.float64).cumsum(0)
    return stamps, torch.tensor([id_ for _, id_ in visits], dtype=torch.int64)


@given(VISITS)
@settings(max_examples=200)
def test_id_switches_equal_a_loop_over_frames(visits: list[tuple[float, int]]) -> None:
    last, switches = 0, 0
    for gap, id_ in visits:
        if gap > 0.5:
            last = 0
        if id_:
            switches += last not in (0, id_)
            last = id_
    assert count_id_switches(*to_tensors(visits), max_absence=0.5) == switches


@pytest.mark.parametrize(("absence", "switches"), [(0.5, 1), (0.5625, 0)])
def test_id_that_changes_after_exactly_the_maximum_absence_is_a_switch(absence: float, switches: int) -> None:
    assert count_id_switches(*to_tensors([(0.0, 1), (absence, 2)]), max_absence=0.5) == switches


@given(VISITS)
@settings(max_examples=50)
def test_id_switches_are_invariant_to_renaming_and_grow_with_absence(visits: list[tuple[float, int]]) -> None:
    stamps, ids = to_tensors(visits)
    renamed = torch.tensor([0, 17, 4, 9])[ids]
    switches = count_id_switches(stamps, ids, max_absence=0.5)
    assert count_id_switches(stamps, renamed, max_absence=0.5) == switches
    assert (
        count_id_switches(stamps, ids, max_absence=10.0)
        >= switches
        >= count_id_switches(stamps, ids, max_absence=0.05)
        == 0
    )


def person_at(column: int, value: int = 1) -> Tensor:
    truth = torch.zeros(48, 64, dtype=torch.uint8)
    truth[:, column : column + 10] = value
    return truth


def test_people_are_scored_by_frames_in_which_they_are_found_and_by_switches_of_ids() -> None:
    """The first switches ids twice, is missed, and returns with another id. The second is out of view for long."""
    evaluation = MaskEvaluation()
    depth, nothing = torch.ones(1, 48, 64), torch.zeros(48, 64, dtype=torch.bool)
    first = [3, 3, 8, 3, 0, 0, 9, 9]  # 3 switches: to 8, back to 3, and to 9 over the gap
    second = [5, 5, None, None, None, None, None, 6]  # 0.6 s out of view: 6 is not a switch
    for frame, (a, b) in enumerate(zip(first, second, strict=True)):
        truth = person_at(2) + (person_at(40, 2) if b is not None else 0)
        objects = {id_: mask for id_, mask in ((a, person_at(2) > 0), (b, person_at(41) > 0)) if id_}
        evaluation.add(frame / 10, truth, depth, nothing, objects)
    scores = evaluation.compute_scores()
    assert scores is not None
    assert [(p.id, p.in_view, p.found, p.id_switches) for p in scores.people] == [(1, 8, 6, 3), (2, 3, 3, 0)]
    assert scores.id_switches_per_60_frames == pytest.approx(60 * 3 / 11)
    assert scores.people_found == 9 / 11
    assert json.loads(json.dumps(scores.to_dict()))["people"][0]["id_switches"] == 3


def test_person_with_few_pixels_is_not_in_view() -> None:
    """0.3 % of 48 x 64 pixels are 9 pixels, and they need depth."""
    for pixels, without_depth, in_view in ((8, 0, []), (9, 0, [7]), (9, 1, [])):
        truth, depth = torch.zeros(48, 64, dtype=torch.uint8), torch.ones(1, 48, 64)
        truth[0, :pixels] = 7
        depth[0, 0, :without_depth] = 0
        evaluation = MaskEvaluation()
        evaluation.add(0.0, truth, depth, truth > 0, {})
        scores = evaluation.compute_scores()
        assert scores is not None
        assert [person.id for person in scores.people] == in_view


# --- ground-truth masks from files


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Five frames of a camera that slides along a noisy wall, with depth 4 ms after colour."""
    root = tmp_path / "wall"
    noise = np.random.default_rng(0).integers(0, 256, (60, 120, 3), dtype=np.uint8)
    wall = cv2.resize(noise, (480, 240), interpolation=cv2.INTER_CUBIC)
    lines = []
    for k in range(5):
        colour, depth = f"{1 + k / 10:.6f}", f"{1.004 + k / 10:.6f}"
        write_png(root / "rgb" / f"{colour}.png", wall[:, 4 * k : 4 * k + 320])
        write_png(root / "depth" / f"{depth}.png", np.full((240, 320), 10_000, np.uint16))
        mask = np.zeros((240, 320), np.uint8)
        mask[90:150, 130:190] = 7 + k
        write_png(root / "masks" / f"{depth}.png", mask)
        lines.append(f"{colour} rgb/{colour}.png {depth} depth/{depth}.png")
    (root / "associations.txt").write_text("\n".join(lines) + "\n")
    (root / "camera.yaml").write_text(
        "width: 320\nheight: 240\nfx: 260.0\nfy: 260.0\ncx: 159.5\ncy: 119.5\ndepth_scale: 5000\n"
    )
    return root


def test_convention_ground_truth_masks_are_named_by_depth_stamp(folder: Path) -> None:
    sequence = TUMSequence(folder)
    assert isinstance(sequence, HasMotionMasks)
    for index in range(5):
        truth = sequence.motion_mask(index)
        assert truth is not None
        assert truth.dtype == torch.uint8 and truth.shape == (240, 320)
        assert truth.unique().tolist() == [0, 7 + index] and int((truth > 0).sum()) == 60 * 60


def test_frame_without_ground_truth_mask_has_none(folder: Path) -> None:
    (folder / "masks" / "1.204000.png").unlink()
    sequence = TUMSequence(folder)
    assert [sequence.motion_mask(index) is None for index in range(5)] == [False, False, True, False, False]


@pytest.mark.parametrize("case", ["colour", "16 bit", "truncated", "size"])
def test_invalid_ground_truth_mask_is_an_error_with_its_path(case: str, folder: Path) -> None:
    path = folder / "masks" / "1.004000.png"
    images = {"colour": np.zeros((240, 320, 3), np.uint8), "16 bit": np.zeros((240, 320), np.uint16)}
    if case == "truncated":
        path.write_bytes(path.read_bytes()[:100])
    else:
        write_png(path, images.get(case, np.zeros((100, 100), np.uint8)))
    cause = "has 100x100" if case == "size" else "is truncated or not an 8-bit greyscale motion mask"
    with pytest.raises(InputError, match=rf"masks/1\.004000\.png: {cause}"):
        TUMSequence(folder).motion_mask(0)


# --- scores of a run


def square(frame: RGBDFrame) -> Instances:
    """Return the person, three columns too far left."""
    mask = torch.zeros(1, 240, 320, dtype=torch.bool)
    mask[:, 90:150, 127:187] = True
    return Instances(mask, torch.zeros(1, dtype=torch.int64), torch.ones(1), torch.tensor([[127.0, 90, 187, 150]]))


def run(folder: Path, out: Path) -> dict[str, object]:
    """Return the metrics of a run over the wall in which the network finds the square."""
    sequence = TUMSequence(folder)
    exact = [f"objects.static_mask.{growth}=0" for growth in ("depth_margin", "surface_margin", "dilation")]
    config = load_config(overrides=[*exact, "objects.clouds.stride=1"])
    pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, square, config), out / "masks")
    pipeline()
    pipeline.flush()
    write_results(out, pipeline)
    return json.loads((out / "metrics.json").read_text())


@pytest.mark.usefixtures("no_figures")
def test_run_is_scored_and_does_not_depend_on_ground_truth_masks(folder: Path, tmp_path: Path) -> None:
    for path in (folder / "masks").iterdir():  # the same person in all frames
        write_png(path, cv2.imread(str(path), cv2.IMREAD_UNCHANGED).clip(0, 1))
    metrics = run(folder, tmp_path / "known")
    assert metrics["failure"] is None
    masks = metrics["masks"]
    assert isinstance(masks, dict)
    assert masks["frames"] == 5
    assert masks["moving_masked"] == 57 / 60
    assert masks["static_masked"] == masks["static_masked_anywhere"] == 3 * 60 / (240 * 320 - 60 * 60)
    assert masks["id_switches_per_60_frames"] == 0.0 and masks["people_found"] == 1.0
    assert masks["people"] == [{"id": 1, "in_view": 5, "found": 5, "id_switches": 0}]

    shutil.rmtree(folder / "masks")
    assert run(folder, tmp_path / "unknown")["masks"] is None
    for name in ("trajectory.txt", "keyframes.txt", "map.ply", "objects.parquet", "masks/1.000000.png"):
        assert (tmp_path / "known" / name).read_bytes() == (tmp_path / "unknown" / name).read_bytes(), name


def test_unsure_pixels_count_neither_for_nor_against_an_object() -> None:
    truth = torch.zeros(60, 60, dtype=torch.uint8)
    truth[20:40, 20:40] = UNSURE
    truth[23:37, 23:37] = 1
    assert covering_ids(truth, torch.tensor([1]), {7: truth > 0}).tolist() == [7]


@pytest.mark.skipif(os.name == "nt", reason="all names are Unicode")
def test_true_masks_in_a_folder_whose_name_is_not_utf8_are_read(folder: Path) -> None:
    renamed = folder.rename(folder.parent / os.fsdecode(b"v\xffwall"))
    assert TUMSequence(renamed).motion_mask(0) is not None
