"""Trajectory files in TUM format, compared with evo's reader and writer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.datasets.tum_trajectory import read_groundtruth, read_trajectory, write_trajectory
from v3d_torch.errors import InputError, OutputError
from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory


def random_trajectory(poses: int, seed: int) -> Trajectory:
    generator = torch.Generator().manual_seed(seed)
    xi = torch.randn(poses, 6, dtype=torch.float64, generator=generator)
    stamps = 1305031098.665862 + 0.033 * torch.arange(poses, dtype=torch.float64)
    return Trajectory((stamps * 1e6).round() / 1e6, se3_exp(2 * xi))


def write(folder: Path, text: str) -> Path:
    path = folder / "trajectory.txt"
    path.write_bytes(text.encode())
    return path


def test_convention_camera_to_world_scalar_last(tmp_path: Path) -> None:
    """The x axis of a camera at (1, 2, 3), rotated by 90 degrees about world z, is the world y axis."""
    trajectory = read_trajectory(write(tmp_path, f"7.5 1 2 3 0 0 {0.5**0.5} {0.5**0.5}\n"))
    assert trajectory.stamps.tolist() == [7.5]
    p_w = trajectory.T_wc[0] @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    assert p_w.tolist() == pytest.approx([1, 3, 3, 1])
    assert trajectory.T_wc.dtype == trajectory.stamps.dtype == torch.float64


@given(seed=st.integers(0, 10_000), poses=st.integers(1, 20))
def test_written_trajectory_is_read_back(seed: int, poses: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("round") / "trajectory.txt"
    trajectory = random_trajectory(poses, seed)
    write_trajectory(path, trajectory)
    back = read_trajectory(path)
    assert torch.equal(back.stamps, trajectory.stamps)
    assert torch.allclose(back.T_wc, trajectory.T_wc, rtol=0, atol=5e-9)


def test_evo_reads_written_trajectory(tmp_path: Path) -> None:
    trajectory = random_trajectory(50, seed=1)
    write_trajectory(tmp_path / "trajectory.txt", trajectory)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.txt")
    np.testing.assert_array_equal(theirs.timestamps, trajectory.stamps.numpy())
    np.testing.assert_allclose(np.stack(theirs.poses_se3), trajectory.T_wc.numpy(), rtol=0, atol=5e-9)


def test_trajectory_written_by_evo_is_read(tmp_path: Path) -> None:
    trajectory = random_trajectory(50, seed=2)
    theirs = PoseTrajectory3D(poses_se3=list(trajectory.T_wc.numpy()), timestamps=trajectory.stamps.numpy())
    file_interface.write_tum_trajectory_file(tmp_path / "evo.txt", theirs)
    back = read_trajectory(tmp_path / "evo.txt")
    assert torch.allclose(back.T_wc, trajectory.T_wc, rtol=0, atol=1e-12)


def test_line_has_fixed_decimals_without_negative_zeros(tmp_path: Path) -> None:
    """Six decimals for the timestamp, nine for the other columns."""
    T_wc = torch.eye(4, dtype=torch.float64).repeat(1, 1, 1)
    T_wc[0, 0, 3] = -1e-12
    write_trajectory(
        tmp_path / "new" / "trajectory.txt", Trajectory(torch.tensor([0.1234567], dtype=torch.float64), T_wc)
    )
    zero = "0.000000000"
    assert (tmp_path / "new" / "trajectory.txt").read_text() == f"0.123457 {' '.join([zero] * 6)} 1.000000000\n"


def test_convention_quaternions_are_written_with_qw_positive(tmp_path: Path) -> None:
    """q and -q are the same rotation; the written one is unique."""
    write_trajectory(tmp_path / "trajectory.txt", random_trajectory(200, seed=3))
    assert np.loadtxt(tmp_path / "trajectory.txt")[:, 7].min() >= 0


def test_comments_blank_lines_commas_and_line_ends_are_accepted(tmp_path: Path) -> None:
    text = "\ufeff# stamp tx ty tz\r\n\r\n  # more\r\n1.0 1 0 0 0 0 0 2\r\n2.0\t2,0,0,0,0,0,1 \r\n"
    trajectory = read_trajectory(write(tmp_path, text))
    assert trajectory.stamps.tolist() == [1.0, 2.0]
    assert trajectory.T_wc[:, 0, 3].tolist() == [1.0, 2.0]
    assert torch.equal(trajectory.T_wc[0, :3, :3], torch.eye(3, dtype=torch.float64))  # the quaternion had length 2


def test_poses_are_sorted_and_first_of_equal_stamps_is_kept(tmp_path: Path) -> None:
    lines = [f"{stamp} {x} 0 0 0 0 0 1" for stamp, x in ((3, 30), (1, 10), (2, 20), (1, 11), (3, 31))]
    trajectory = read_trajectory(write(tmp_path, "\n".join(lines)))
    assert trajectory.stamps.tolist() == [1, 2, 3]
    assert trajectory.T_wc[:, 0, 3].tolist() == [10, 20, 30]


def assert_is_read_as(text: str, folder: Path) -> None:
    """Check that a file has a pose at 1403636580.8386 s, at (1, 2, 3), turned by 90 degrees about z."""
    trajectory = read_trajectory(write(folder, text))
    assert trajectory.stamps.tolist() == pytest.approx([1403636580.8386])
    assert trajectory.T_wc[0, :3].flatten().tolist() == pytest.approx([0, -1, 0, 1, 1, 0, 0, 2, 0, 0, 1, 3])


HALF = 0.5**0.5
EUROC = f"1403636580838600000,1,2,3,{HALF},0,0,{HALF}"


@pytest.mark.parametrize(
    "text",
    [
        f"#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n{EUROC}\n",
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [],"
        f" v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1]\n{EUROC},9,9\n",
        f"# made by hand\n# time qx qy qz qw px py pz\n1403636580.8386 0 0 {HALF} {HALF} 1 2 3\n",
        f"#timestamp,tx,ty,tz,qx,qy,qz,qw\n1403636580838600000,1,2,3,0,0,{HALF},{HALF}\n",
    ],
)
def test_comment_states_the_order_of_the_columns(text: str, tmp_path: Path) -> None:
    """EuRoC and evo write the scalar of a quaternion first."""
    assert_is_read_as(text, tmp_path)


def test_commas_and_nanoseconds_need_a_comment_with_the_order(tmp_path: Path) -> None:
    message = (
        "line 1 has commas and nanoseconds as in files of EuRoC, which have qw before qx, but no comment names the"
    )
    with pytest.raises(InputError, match=message):
        read_trajectory(write(tmp_path, EUROC))
    assert_is_read_as(f"1403636580.8386,1,2,3,0,0,{HALF},{HALF}\n", tmp_path)
    assert_is_read_as(f"1403636580838600000 1 2 3 0 0 {HALF} {HALF}\n", tmp_path)


def test_poses_that_are_not_finite_are_missing_in_a_ground_truth(tmp_path: Path) -> None:
    lines = [f"{stamp} {x} 0 0 0 0 0 1" for stamp, x in enumerate((1, "nan", "-1.#INF", "1.#QNAN", 5))]
    truth = read_groundtruth(write(tmp_path, "\n".join(lines)))
    assert truth.trajectory.stamps.tolist() == [0, 4] and truth.missing == 3
    assert truth.note == "3 of 5 poses of the ground truth are empty or not finite and are left out"
    with pytest.raises(InputError, match="line 1 has a number that is not finite"):
        read_groundtruth(write(tmp_path, lines[1]))
    with pytest.raises(InputError, match="line 2 has a number that is not finite"):
        read_groundtruth(write(tmp_path, f"{lines[0]}\nnan 0 0 0 0 0 0 1\n"))


def test_number_of_columns_is_in_the_error(tmp_path: Path) -> None:
    message = "line 1 has 9 columns, expected 8: timestamp tx ty tz qx qy qz qw; remove the others"
    with pytest.raises(InputError, match=message):
        read_trajectory(write(tmp_path, "1 0 0 0 0 0 0 1 9\n"))


GOOD = "# header\n1 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no poses"),
        ("# only a comment\n\n", "contains no poses"),
        (GOOD + "2 0 0 0 0 0 0\n", "line 3"),
        (GOOD + "2 0 0 0 0 0 0 1 9\n", "line 3"),
        (GOOD + "2 0 0 zero 0 0 0 1\n", "line 3"),
        (GOOD + "1_0 0 0 0 0 0 0 1\n", "line 3"),
        (GOOD + "2 0 0 \u0661 0 0 0 1\n", "line 3"),
        (GOOD + "\n2 0 0 nan 0 0 0 1\n", "line 4 has a number that is not finite"),
        (GOOD + "inf 0 0 0 0 0 0 1\n", "line 3 has a number that is not finite"),
        (GOOD + "2 0 0 0 0 0 0 0\n3 0 0 0 0 0 0 0\n", "line 3 has a quaternion that is zero"),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw\n" + GOOD, "line 1"),
    ],
)
def test_invalid_trajectory_file_is_rejected_with_path_and_line(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as error:
        read_trajectory(path)
    assert str(path) in str(error.value) and message in str(error.value)


def test_missing_file_folder_and_binary_file_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\xff\xfe\x00")
    for path in (tmp_path / "none.txt", tmp_path, tmp_path / "picture.png"):
        with pytest.raises(InputError, match=path.name):
            read_trajectory(path)


def test_empty_trajectory_is_written_as_empty_file(tmp_path: Path) -> None:
    nothing = Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
    write_trajectory(tmp_path / "trajectory.txt", nothing)
    assert (tmp_path / "trajectory.txt").read_bytes() == b""


def test_each_line_of_a_comment_is_a_comment(tmp_path: Path) -> None:
    trajectory = random_trajectory(2, seed=0)
    write_trajectory(tmp_path / "trajectory.txt", trajectory, comment="room 5\n9 0 0 0 0 0 0 1\r\n\nsecond run")
    assert (tmp_path / "trajectory.txt").read_text().startswith("# room 5\n# 9 0 0 0 0 0 0 1\n# \n# second run\n")
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == 2


def test_unwritable_file_raises_output_error(tmp_path: Path) -> None:
    (tmp_path / "trajectory.txt").mkdir()
    with pytest.raises(OutputError, match=r"trajectory\.txt"):
        write_trajectory(tmp_path / "trajectory.txt", random_trajectory(2, seed=0))


def test_trajectory_is_created_from_arrays_and_lists(tmp_path: Path) -> None:
    expected = random_trajectory(3, 0)
    stamps, T_wc = expected.stamps.numpy(), expected.T_wc.numpy()
    write_trajectory(tmp_path / "expected.txt", expected)
    for made in (
        Trajectory(stamps, T_wc),
        Trajectory(stamps.tolist(), list(T_wc)),
        Trajectory(stamps[::-1][::-1], T_wc[::-1][::-1]),
    ):
        write_trajectory(tmp_path / "made.txt", made)
        assert (tmp_path / "made.txt").read_bytes() == (tmp_path / "expected.txt").read_bytes()
        assert evaluate(expected, made).ate.rmse < 1e-9
    single = Trajectory(expected.stamps, expected.T_wc.float())
    assert single.T_wc.dtype == torch.float64 and evaluate(expected, single).ate.rmse < 1e-6


@pytest.mark.parametrize(
    ("stamps", "T_wc", "message"),
    [
        (np.zeros(2), np.zeros((3, 4, 4)), r"T_wc of a trajectory have shape \(3, 4, 4\); give"),
        (np.zeros(2), np.zeros((2, 7)), r"T_wc of a trajectory have shape \(2, 7\); give"),
        (np.zeros((2, 1)), np.zeros((2, 4, 4)), r"stamps of a trajectory have shape \(2, 1\); give"),
        (["then", "now"], np.zeros((2, 4, 4)), "stamps of a trajectory are not numbers"),
        (None, None, "stamps of a trajectory"),
        ([1, 3, 2.5, 2], np.zeros((4, 4, 4)), r"stamps .* do not increase \(2.500000 s follows 3.000000 s\); sort the"),
        ([1, 1], np.zeros((2, 4, 4)), r"stamps .* do not increase \(1.000000 s follows 1.000000 s\); sort the poses"),
        ([np.nan], np.zeros((1, 4, 4)), "stamps of a trajectory have a value that is not finite; give seconds"),
        ([1, np.inf], np.zeros((2, 4, 4)), "stamps of a trajectory have a value that is not finite; give seconds"),
        ([1, np.nan], np.zeros((2, 4, 4)), r"stamps of a trajectory do not increase \(nan s follows 1.000000 s\)"),
    ],
)
def test_invalid_trajectory_arguments_are_rejected(stamps: object, T_wc: object, message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        Trajectory(stamps, T_wc)


def test_poses_of_an_empty_trajectory_are_an_input_error() -> None:
    empty = Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
    with pytest.raises(InputError, match=r"^the trajectory has no poses to interpolate; give"):
        empty.poses_at(torch.ones(2, dtype=torch.float64))


def test_poses_at_times_as_list_array_and_tensor_are_equal() -> None:
    trajectory = random_trajectory(5, seed=0)
    stamps = trajectory.stamps[1:4] + 0.01
    expected = trajectory.poses_at(stamps)
    for same in (stamps.numpy(), stamps.tolist(), tuple(stamps.tolist())):
        assert torch.equal(trajectory.poses_at(same), expected)
    assert trajectory.poses_at([]).shape == (0, 4, 4)
    assert torch.equal(trajectory.poses_at([1305031099]), trajectory.poses_at(torch.tensor([1305031099])))


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        (torch.tensor([1305031098.7]), r"stamps have the type torch\.float32; give torch\.float64, because float32"),
        (np.array([1305031098.7], dtype=np.float32), r"stamps have the type torch\.float32; give torch\.float64"),
        (["now"], "stamps are not numbers"),
        ([[1.0], [1.0, 2.0]], "stamps are not numbers"),
    ],
)
def test_times_of_another_type_are_an_input_error(stamps: object, message: str) -> None:
    """In float32, the pose was that of a time up to a minute away."""
    with pytest.raises(InputError, match=f"^{message}"):
        random_trajectory(5, seed=0).poses_at(stamps)


def test_times_less_than_a_microsecond_apart_are_not_lost_without_a_word(tmp_path: Path) -> None:
    """Both poses had the same time in the file, of which the reader used one."""
    T_wc = random_trajectory(3, seed=0).T_wc
    with pytest.raises(
        InputError, match=r"out\.txt: poses 1 and 2 both have the time 0\.100000 s, rounded to 6 decimals;"
    ):
        write_trajectory(tmp_path / "out.txt", Trajectory([0.0, 0.1, 0.1 + 3e-7], T_wc))
    read = read_trajectory(write(tmp_path, "0.1000003 2 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n"))
    assert read.stamps.tolist() == [0.1000003] and read.T_wc[0, 0, 3] == 2
    write_trajectory(tmp_path / "again.txt", read)


def test_invalid_trajectory_is_not_written(tmp_path: Path) -> None:
    path, good = tmp_path / "out.txt", random_trajectory(2, 0)
    with pytest.raises(InputError, match=r"^write_trajectory: expected a Trajectory, got .*Path"):
        write_trajectory(good, path)
    for wrong in (torch.nan, torch.inf, 0.0):
        T_wc = good.T_wc.clone()
        T_wc[1] *= wrong
        with pytest.raises(InputError, match=r"out\.txt: pose 1 is not a valid rigid transform"):
            write_trajectory(path, Trajectory(good.stamps, T_wc))
    assert not path.exists()


@pytest.mark.parametrize(("row", "column", "change"), [(0, 0, 0.5), (0, 1, 0.5), (3, 3, 0.5), (3, 0, 0.5)])
def test_matrix_that_is_no_rigid_transform_is_not_written(row: int, column: int, change: float, tmp_path: Path) -> None:
    """It is scaled along an axis, sheared, or has another last row."""
    T_wc = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    T_wc[2, row, column] += change
    with pytest.raises(InputError, match=r"out\.txt: pose 2 is not a valid rigid transform"):
        write_trajectory(tmp_path / "out.txt", Trajectory(torch.arange(3, dtype=torch.float64), T_wc))
