"""Benchmarks: replays, vocabulary, processes, tables, and the page of all measurements."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import Pipeline
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import accuracy
import degraded
import descriptions
import growth
import heading
import occupancy
import segmentation
import speed
import storage
import tables
import write_page
from heading import Heading
from replay import Replay, again_and_again, back_and_forth
from systems import OURS, vocabulary
from systems.process import Measured, SystemRunError, measure


def measured(rate: float, cpu: float, **stages: float) -> Measured:
    """Run of 100 frames without a pose, with frames per second and CPU ms per frame."""
    return Measured(None, 100, 100 / rate, cpu / 10, stages)


SCRIPTS = sorted(path.stem for path in (Path(__file__).parents[2] / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_script_can_be_imported(name: str) -> None:
    """mypy does not check the benchmarks, and few of them run in tests: a renamed function fails here."""
    try:
        import_module(name)
    except ModuleNotFoundError as error:  # of another package; an ImportError of ours has no other type
        if error.name is None or error.name.partition(".")[0] in {"v3d_torch", *SCRIPTS}:
            raise
        pytest.skip(f"{error.name} is not installed")


class TestDegraded:
    @pytest.mark.parametrize("name", degraded.DEGRADATIONS)
    def test_degraded_sequence_can_be_read_with_its_camera_and_ground_truth(
        self, name: str, moment: Path, tmp_path: Path
    ) -> None:
        sequence, degradation = load_sequence(str(moment)), degraded.DEGRADATIONS[name]
        degraded.write(sequence, degradation, tmp_path / "out")
        written = load_sequence(str(tmp_path / "out"))
        assert torch.equal(written.stamps, sequence.stamps[:: degradation.step])
        assert written.groundtruth is not None
        frame, original = written[0], sequence[0]
        assert frame.image.shape[1:] == (written.camera.height, written.camera.width)
        same = torch.equal(frame.image, original.image), torch.equal(frame.depth, original.depth)
        assert all(same) == (name in {"none", "every second frame"})

    def test_point_has_half_the_pixel_coordinates_at_half_the_resolution(self) -> None:
        """Two pixels are combined, so that the corners of the image are at -0.5 before and after."""
        camera = PinholeCamera(500.0, 510.0, 310.0, 250.0)
        point = torch.tensor([[0.1, -0.2, 1.5]], dtype=torch.float64)
        whole, combined = camera.project(point), degraded.half(camera).project(point)
        assert torch.allclose((whole + 0.5) / 2, combined + 0.5)


class TestReplay:
    def test_again_and_again_starts_anew_after_the_last_frame(self) -> None:
        assert again_and_again(4, 9) == [0, 1, 2, 3, 0, 1, 2, 3, 0]

    def test_back_and_forth_turns_at_the_ends(self) -> None:
        assert back_and_forth(4, 11) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2]

    def test_time_advances_by_intervals_between_frames(self, moment: Path) -> None:
        sequence = load_sequence(str(moment))
        count = len(sequence)
        replay = Replay(sequence, back_and_forth(count, 2 * count))
        gaps = sequence.stamps.diff()
        back = gaps.flip(0)
        assert torch.allclose(replay.stamps.diff(), torch.cat([gaps, back, gaps[:1]])[: 2 * count - 1], atol=1e-5)
        frame = replay[count]
        assert frame.index == count and frame.stamp == float(replay.stamps[count])
        assert torch.equal(frame.image, sequence[count - 2].image)

    def test_replay_of_first_frames_equals_sequence(self, moment: Path) -> None:
        sequence = load_sequence(str(moment))
        replay = Replay(sequence, range(2))
        assert [frame.index for frame in replay] == [0, 1]
        assert torch.allclose(replay.stamps, sequence.stamps[:2], atol=1e-6, rtol=0)

    def test_replayed_frame_has_the_depth_delay_and_gravity_of_the_sequence(self, moment: Path) -> None:
        camera = replace(load_sequence(str(moment)).camera, inverse_depth_offset=0.01)
        sequence = load_sequence(str(moment), camera=camera)
        gravity = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        sequence.gravity, sequence._depth_delays = gravity, [0.012] * len(sequence)
        frame = Replay(sequence, range(3))[0]
        assert torch.equal(frame.depth, sequence[0].depth) and frame.depth_delay == 0.012
        assert frame.gravity is not None and torch.equal(frame.gravity, gravity) and frame.camera == camera


class TestSegmentation:
    def test_all_variants_differ(self) -> None:
        configs = [load_config(overrides=overrides) for overrides in segmentation.VARIANTS.values()]
        assert all(one != other for i, one in enumerate(configs) for other in configs[:i])

    def test_times_and_people_are_stored(self, moment: Path) -> None:
        def segment(frame: RGBDFrame) -> Instances:
            masks = torch.zeros(2, *frame.image.shape[1:], dtype=torch.bool)
            masks[0, : frame.index + 1], masks[1] = True, True
            return Instances(masks, torch.tensor([PERSON, PERSON + 1]), torch.ones(2), torch.zeros(2, 4))

        segmenter = segmentation.MeasuredSegmenter(segment)
        frames = [frame for frame, _ in zip(load_sequence(str(moment)), range(2), strict=False)]
        assert [len(segmenter(frame)) for frame in frames] == [2, 2]
        width = segmenter.people[0].shape[1]
        assert {index: int(mask.sum()) for index, mask in segmenter.people.items()} == {0: width, 1: 2 * width}
        assert len(segmenter.seconds) == 2


@pytest.fixture(scope="module")
def patterns() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (60, 32), dtype=np.uint8)


@pytest.fixture(scope="module")
def levels(patterns: np.ndarray) -> list[vocabulary.Level]:
    """Tree trained on 60 patterns, each observed 30 times with about eight wrong bits, the i-th in 1 + i % 5 images."""
    generator = np.random.default_rng(1)
    observed = np.repeat(patterns, 30, axis=0)
    flips = np.packbits(generator.random((len(observed), 256)) < 1 / 32, axis=1)
    images = np.concatenate([np.arange(30) % (1 + i % 5) for i in range(60)])
    return vocabulary.train(observed ^ flips, images)


class TestVocabulary:
    def test_text_is_a_tree_in_dbow2_format(self, levels: list[vocabulary.Level]) -> None:
        text = vocabulary.text(levels)
        assert not text.endswith("\n")  # DBoW2 would parse an empty line as a node
        head, *lines = text.split("\n")
        assert head == "10 6 0 0"
        depth, children, leaves = [0], [0], [False]
        for line in lines:
            parent, leaf, *numbers, weight = line.split(" ")
            assert len(numbers) == 32 and all(0 <= int(number) < 256 for number in numbers)
            assert int(parent) < len(depth) and not leaves[int(parent)]  # an earlier node that is not a word
            children[int(parent)] += 1
            depth.append(depth[int(parent)] + 1)
            children.append(0)
            leaves.append(leaf == "1")
            assert float(weight) >= 0 and (leaf == "1" or float(weight) == 0)
        assert max(depth) <= 6 and max(children) <= 10
        assert all(leaf == (count == 0) for leaf, count in zip(leaves, children, strict=True))

    def test_pattern_descends_to_similar_word(self, levels: list[vocabulary.Level], patterns: np.ndarray) -> None:
        """Going to the nearest child at each level, as DBoW2 does, most patterns end in a similar word."""
        errors = []
        for pattern in patterns:
            above = -1
            for level in levels:
                nodes = np.flatnonzero(level.parent == above) if above >= 0 else np.arange(len(level.parent))
                distances = np.bitwise_count(level.centre[nodes] ^ pattern).sum(axis=1)
                above = nodes[distances.argmin()]
                if level.leaf[above]:
                    break
            errors.append(distances.min())
        assert np.median(errors) <= 8  # 128 by chance

    def test_weight_is_inverse_document_frequency(self) -> None:
        """Ten descriptors are ten words: those in all five images weigh 0, those in one image weigh log 5."""
        descriptors = np.random.default_rng(0).integers(0, 256, (10, 32), dtype=np.uint8)
        observed = np.concatenate([np.repeat(descriptors[:5], 5, axis=0), descriptors[5:]])
        (level,) = vocabulary.train(observed, np.concatenate([np.tile(np.arange(5), 5), np.arange(5)]), smallest=100)
        weights = {bytes(centre): weight for centre, weight in zip(level.centre, level.weight, strict=True)}
        exact = [weights[bytes(d)] for d in descriptors if bytes(d) in weights]
        assert exact and all(weight in (0.0, pytest.approx(np.log(5))) for weight in exact)


class TestProcess:
    def test_our_system_tracks_first_frames(self, moment: Path) -> None:
        run = measure("v3d_torch --segmenter none", str(moment), moment.parent, frames=2)
        assert run.frames == 2 and run.trajectory is not None and len(run.trajectory) == 2
        assert run.seconds > 0 and run.cpu_seconds > 0
        assert {"read", "features", "tracking"} <= set(run.stages)
        assert torch.allclose(run.trajectory.T_wc[0], torch.eye(4, dtype=torch.float64))

    def test_failure_is_one_line(self, tmp_path: Path) -> None:
        with pytest.raises(SystemRunError, match=r"^\S*nowhere: "):
            measure("v3d_torch --segmenter none", str(tmp_path / "nowhere"), tmp_path)

    def test_missing_peer_fails_with_its_name(
        self, moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "pyorbslam3.py").write_text("raise ImportError('no pyorbslam3 here')\n")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
        with pytest.raises(SystemRunError, match=r"^no pyorbslam3 here$"):
            measure("pyorbslam3", str(moment), moment.parent)


def test_orbslam3_settings_contain_camera() -> None:
    pytest.importorskip("pyorbslam3", reason="ORB-SLAM3 is not installed")
    from systems.orbslam3 import settings

    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    in_memory = cv2.FileStorage_READ | cv2.FileStorage_MEMORY
    read = cv2.FileStorage(settings(camera, 30), in_memory)
    values = [read.getNode(f"Camera1.{name}").real() for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")]
    assert values == pytest.approx([517.3, 516.5, 318.6, 255.3, *camera.distortion])
    assert read.getNode("Camera.RGB").real() == 1 and read.getNode("RGBD.DepthMapFactor").real() == 1
    ideal = cv2.FileStorage(settings(PinholeCamera(500, 500, 320, 240), 5), in_memory)
    assert ideal.getNode("Camera1.k1").empty() and ideal.getNode("Camera.fps").real() == 5


class TestTables:
    def test_ratios_compare_with_the_runs_of_the_reference_just_before_and_after(self) -> None:
        """Ours is half as fast as the reference; the machine becomes slower, in and between the turns."""
        turns: list[speed.Turn] = []
        for slow in (1, 2):
            ours = measured(20 / slow, 90 * slow, read=0.5 * slow)
            before, after = measured(50 / slow, 20 * slow), measured(30 / slow, 40 * slow)
            end = measured(1 / slow, 900 * slow)
            turns.append(
                [
                    (speed.REFERENCE, before),
                    ("v3d_torch", ours),
                    (speed.REFERENCE, after),
                    ("open3d", "broke"),
                    (speed.REFERENCE, end),
                ]
            )
        rows = {
            cells[1].strip(): [cell.strip() for cell in cells[2:-1]]
            for cells in (line.split("|") for line in speed.speed_table(turns))
        }
        assert rows["v3d_torch"] == ["15.0 [10.0-20.0]", "0.50", "135.0 [90.0-180.0]", "3.00", "0%", "0 of 2"]
        assert rows["open3d"] == ["-", "-", "-", "-", "-", "2 of 2"]
        assert rows[speed.REFERENCE][1::2] == ["1.00", "1.00", "0 of 6"]
        assert list(speed.stage_table(turns))[2] == "| read | 7.5 [5.0-10.0] | - | - | - |"
        assert "- turn 2, open3d: broke" in list(speed.failures(turns))

    def test_accuracy_table_has_ours_then_peers_then_published(self, tmp_path: Path) -> None:
        known = {"sequences": {"a": {"what": "a room", "ate": {"ORB-SLAM3": "0.5"}}}}
        figures = {"frames": 9, "ate": {"rmse": 0.25}, "fps": 3.0, "coverage": 0.5}
        outcomes = [accuracy.Outcome("a", name, 0, figures) for name in ("full", "pyorbslam3")]
        head, _, line = accuracy.accuracy_table(outcomes, known, tmp_path)
        assert head == "| sequence | what | frames | full | pyorbslam3 | ORB-SLAM3 (not rerun) |"
        assert line == "| a | a room | 9 | 0.2500 | 0.2500 | 0.5 |"
        assert list(accuracy.runs_table(outcomes))[3] == "| a | pyorbslam3 | 0 of 1 | - | - | - | - | 50.0% | 3.0 |"

    def test_run_without_ground_truth_has_no_score(self) -> None:
        assert accuracy.Outcome("a", "full", 0, {"ate": None, "fps": 1.0}).ate is None


def test_pose_graph_closes_drifting_ring() -> None:
    cells = growth.close_ring(60, torch.Generator().manual_seed(0))
    assert int(cells["iterations"]) > 0 and float(cells["error_after"]) < float(cells["error_before"])


def test_blocks_of_a_long_run_are_measured_between_new_systems() -> None:
    slam = V3DSLAM(PinholeCamera(50.0, 50.0, 32.0, 24.0, 64, 48), NoSegmentation())
    poses: list[int] = []
    slam.poses = poses  # type: ignore[assignment]  # only their number is needed
    times = iter(range(2, 100, 2))
    recorder = growth.BlockRecorder(slam, 25, lambda: float(next(times)))
    for frame in range(25):
        poses.append(frame)
        recorder()
    blocks = recorder.blocks
    assert [block.first for block in blocks] == [0, *(block.end for block in blocks[:-1])]
    assert [block.end for block in blocks] == [2, 5, 7, 10, 12, 15, 17, 20, 22, 25]
    assert [block.reference_ms for block in blocks] == [3.0 + 2 * block for block in range(10)]
    assert all(0 < block.slowest_ms <= (block.end - block.first) * block.wall_ms * (1 + 1e-9) for block in blocks)


def test_costs_of_an_occupancy_map_are_measured_beside_octomap(moment: Path) -> None:
    sequence = load_sequence(str(moment))
    config = load_config(overrides=["segmentation.source=none", "occupancy.enabled=true", "occupancy.interval=1"])
    pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, config=config))
    pipeline()
    assert pipeline.slam.occupancy is not None
    row = occupancy.measure_costs(pipeline, pipeline.slam.occupancy)
    assert float(row["octomap_ms"]) > 0 and float(row["cpu_ms"]) > 0 and float(row["memory_mb"]) > 0


def test_our_systems_have_options() -> None:
    from systems.ours import OPTIONS

    assert tuple(OPTIONS) == OURS


class TestPage:
    HEADING = Heading("python benchmarks/speed.py", "abc1234", "2026-01-02", "2 cores")

    def test_page_is_made_of_stored_measurements(self) -> None:
        assert write_page.PAGE.read_text(encoding="utf-8") == write_page.page()

    def test_readme_tables_are_made_of_stored_measurements(self) -> None:
        readme = write_page.README.read_text(encoding="utf-8")
        assert readme == write_page.insert_tables(readme, write_page.main_tables())

    def test_speeds_of_systems_that_are_not_run_are_those_of_their_file(self, monkeypatch: pytest.MonkeyPatch) -> None:
        speed = {name: {"fps": fps, "cpu_ms": 2 * fps} for name, fps in (("A", 11), ("B", 12), ("C", 13))}
        monkeypatch.setitem(descriptions.PEERS, "speed", speed)
        assert "A, B and C process 11, 12 and 13 frames per second." in write_page.main_tables()
        assert "process 11, 12 and 13 frames per second with 22, 24 and 26 CPU ms per frame" in write_page.page()

    def test_missing_marks_are_an_error(self) -> None:
        with pytest.raises(ValueError, match=r"benchmarks:main"):
            write_page.insert_tables(f"text {write_page.BEGIN} text", "table")

    def test_text_around_the_marks_is_kept(self) -> None:
        readme = f"before\n{write_page.BEGIN}\nold\n{write_page.END}\nafter\n"
        expected = f"before\n{write_page.BEGIN}\nnew\n{write_page.END}\nafter\n"
        assert write_page.insert_tables(readme, "new") == expected

    def test_section_without_measurements_is_left_out(self, tmp_path: Path) -> None:
        rows = [{"keyframes": "500", "query_ms": "1.4"}]
        storage.save("keyframes", storage.Measurement(self.HEADING, rows), tmp_path)
        page = write_page.page(tmp_path)
        assert [line for line in page.splitlines() if line.startswith("## ")] == ["## Growth"]
        assert "| 500 | 1.4 |" in page
        assert "`python benchmarks/speed.py`; commit abc1234; 2026-01-02; 2 cores" in page

    def test_newer_row_replaces_older_row_with_same_keys(self, tmp_path: Path) -> None:
        for commit, rows in (("a", {"500": "1", "900": "2"}), ("b", {"500": "3"}), ("c", {"900": "4"})):
            cells = [{"keyframes": count, "query_ms": value} for count, value in rows.items()]
            of_commit = Heading("", commit, "2026-01-02", "2 cores")
            storage.save("keyframes", storage.Measurement(of_commit, cells, [commit]), tmp_path)
        stored = storage.load("keyframes", tmp_path)
        assert [(measured.heading.commit, list(measured.rows)) for measured in stored] == [
            ("b", [{"keyframes": "500", "query_ms": "3"}]),
            ("c", [{"keyframes": "900", "query_ms": "4"}]),
        ]

    def test_notes_of_a_measurement_that_lost_rows_are_removed(self, tmp_path: Path) -> None:
        for counts in ((500, 900), (700,), (500,)):
            rows = [{"keyframes": str(count)} for count in counts]
            storage.save("keyframes", storage.Measurement(self.HEADING, rows, [f"of {counts}"]), tmp_path)
        notes = [list(measured.notes) for measured in storage.load("keyframes", tmp_path)]
        assert notes == [[], ["of (700,)"], ["of (500,)"]]

    def test_heading_names_both_commits_if_the_checkout_changes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        started = heading.make_heading()
        assert started.until_now() == started
        monkeypatch.setattr(heading, "current_commit", lambda: "abc1234-dirty")
        assert started.until_now().commit == f"{started.commit} to abc1234-dirty"

    def test_every_stored_row_has_its_keys_once(self) -> None:
        for path in storage.RESULTS.glob("*.json"):
            measurements = storage.load(path.stem)
            keys = [storage.key_of(path.stem, row) for measured in measurements for row in measured.rows]
            assert keys and len(set(keys)) == len(keys), path.name
            assert all(measured.heading.commit and measured.heading.date for measured in measurements), path.name

    def test_lowest_value_is_bold(self) -> None:
        assert tables.mark_lowest(["0.2 [0.1-0.3]", "0.5", "-", "0.2 (92%)"]) == [
            "**0.2** [0.1-0.3]",
            "0.5",
            "-",
            "**0.2** (92%)",
        ]

    def test_saved_rows_of_a_script_fill_its_section(self, tmp_path: Path) -> None:
        figures = {"frames": 9, "ate": {"rmse": 0.25}, "fps": 3.0, "coverage": 0.5}
        outcomes = [accuracy.Outcome("walkers_desk", name, 0, figures) for name in ("full", "pyorbslam3")]
        storage.save("accuracy", storage.Measurement(self.HEADING, list(accuracy.accuracy_rows(outcomes))), tmp_path)
        reference = speed.REFERENCE, measured(40, 30)
        turn: speed.Turn = [reference, ("v3d_torch", measured(20, 90, read=0.5)), reference]
        cells = {"sequence": "walkers_desk"}
        rows = [cells | row for row in speed.system_rows([turn])]
        storage.save("speed", storage.Measurement(self.HEADING, rows), tmp_path)
        page = write_page.page(tmp_path)
        assert "| walkers_desk (composed; people in fr1_rpy) | 9 | 0.2500 (50% of the frames) |" in page
        assert "| v3d_torch | 20.0 (90.0) | 0.50 |" in page
        assert "| **0.017** |" in write_page.main_tables(tmp_path)

    @pytest.mark.parametrize(("has_int8", "file"), [(True, "tracks"), (False, "tracks_float32")])
    def test_each_kind_of_processor_has_its_own_files(
        self, has_int8: bool, file: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(storage, "has_int8_instructions", lambda: has_int8)
        assert storage.file_of("tracks") == file
        assert file in storage.KEYS

    def test_table_of_speed_has_a_row_for_every_measured_system(self) -> None:
        turn: speed.Turn = [(name, measured(20, 90)) for name in speed.SYSTEMS]
        rows = [{"sequence": "walkers_desk"} | row for row in speed.system_rows([turn])]
        lines = list(tables.speed_table([storage.Measurement(self.HEADING, rows)]))
        assert len(lines) == 2 + len(speed.SYSTEMS)
        unknown = storage.Measurement(self.HEADING, [rows[0] | {"system": "unknown"}])
        with pytest.raises(ValueError, match="unknown"):
            list(tables.speed_table([unknown]))
