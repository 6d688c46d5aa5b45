"""Sweeps whose cells share processes: which do, and that each is what it is by itself."""

from pathlib import Path

import pytest
from commands import run_command

from coop.records.locks import RunLock
from coop.records.summaries import read_summary
from coop.studies.sweep.folder import CellFolder
from coop.studies.sweep.grid import Grid, parse_grid
from coop.studies.sweep.local import LocalProcesses
from coop.studies.sweep.stacking import MOST, stacks_of

pytest.importorskip("numba")
pytestmark = pytest.mark.timeout(300)

GRID = """
methods = ["dqn", "medqn"]
seeds = [4, 5, 6]
[fixed]
total_steps = 300
replay.capacity = 100
replay.learning_starts = 50
"""


def cells_of(text: str, folder: Path) -> tuple[Grid, list[CellFolder]]:
    grid = parse_grid(text, "grid")
    return grid, [CellFolder(folder, cell) for cell in grid.cells]


def sizes(text: str, jobs: int, most: int | None) -> list[int]:
    grid, cells = cells_of(text, Path("nowhere"))
    stacks, _ = stacks_of(grid.file, cells, jobs, most)
    return sorted(len(part) for part in set(stacks.values()))


def test_cells_that_differ_in_their_seeds_alone_share_processes() -> None:
    many = GRID.replace("[4, 5, 6]", str(list(range(40)))).replace(', "medqn"', "")
    assert sizes(GRID, 1, None) == [3]
    assert sizes(GRID, 2, None) == [2], "as many processes as jobs; the third is alone"
    assert sizes(many, 1, None) == [40 - MOST, MOST]
    assert sizes(many, 2, None) == [20, 20]
    assert sizes(many, 1, 10) == [10] * 4
    assert sizes(many, 1, 1) == []
    two = many.replace("replay.capacity = 100", "") + "[vary]\nreplay.capacity = [100, 200]\n"
    assert sizes(two, 1, 40) == [40, 40]


def test_the_seeds_of_a_cell_are_played_by_one_process(tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    outputs = {}
    for stack, text in (("2", GRID), ("1", GRID.replace(', "medqn"', ""))):
        path.write_text(text.replace("[4, 5, 6]", "[4, 5]"))
        flags = ["--jobs", "1", "--dir", tmp_path / stack, "--stack", stack]
        ran = run_command("coop-sweep", path, *flags, timeout=280)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        outputs[stack] = ran.stdout
    assert "--stack: 2 cells run by themselves: method: only dqn, edql, g-coop, coop" in outputs["2"]
    assert "themselves" not in outputs["1"]
    logs = [len(list((tmp_path / stack).glob("dqn-*/run.log"))) for stack in ("2", "1")]
    assert logs == [1, 2], "a process has one log"
    for seed in (4, 5):
        one, other = (tmp_path / stack / f"dqn-seed={seed}" for stack in ("2", "1"))
        assert read_summary(one)["exit"] == "complete"
        for name in ("episodes.csv", "config.toml"):
            assert (one / name).read_bytes() == (other / name).read_bytes()


def test_a_cell_that_another_process_runs_is_not_taken_along(tmp_path: Path) -> None:
    grid, cells = cells_of(GRID.replace(', "medqn"', ""), tmp_path)
    stacks, _ = stacks_of(grid.file, cells, 1, None)
    executor = LocalProcesses(grid.file, 1, stacks=stacks)
    held = RunLock(cells[1].path, "another", ("learner", "replay")).sign()
    try:
        assert executor.start(cells[0])
        assert executor.start(cells[2]), "taken along"
        assert not executor.start(cells[1])
        assert executor.slots() == 2
        command, arguments = Path(f"/proc/{executor._processes[cells[0].cell.name].pid}/cmdline"), [""]
        while not any("seed=" in each for each in arguments):  # until the process has become the command
            arguments = command.read_text().split("\0")
        assert [Path(each).name for each in arguments if "seed=" in each] == ["dqn-seed=4", "dqn-seed=6"]
    finally:
        executor.stop(60)
        held.release()
