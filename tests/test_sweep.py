"""Sweeps: bad grids are refused, kills and Ctrl-C lose nothing, failures are listed, job arrays run the same cells."""

import csv
import fcntl
import json
import os
import signal
import subprocess
import time
import tomllib
from pathlib import Path

import pytest
from commands import Command, run_command, wait_for

from coop.common.errors import UsageError
from coop.common.settings.medqn import MedqnSettings
from coop.common.settings.tables import resolve
from coop.studies.sweep.cli import SweepOptions, chosen, main
from coop.studies.sweep.folder import CellFolder, claim_folder
from coop.studies.sweep.grid import load_grid, parse_grid, shipped_grids
from coop.studies.sweep.local import LocalProcesses
from coop.studies.tuning import tune

pytestmark = pytest.mark.timeout(300)  # a dozen processes, one after the other, also on a machine that is busy
NAMED = "CUDA_VISIBLE_DEVICES="
TINY = 'methods = ["dqn", "coop"]\n[fixed]\ntotal_steps = 900\nreplay.capacity = 300\nlearner.swap_every = 10\n'


def sweep(*flags: str, path: str = os.environ["PATH"]) -> subprocess.CompletedProcess[str]:
    return run_command("coop-sweep", *flags, environment={**os.environ, "PATH": path}, timeout=250)


def summaries(folder: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in folder.glob("*/summary.json")}


@pytest.mark.parametrize("name", shipped_grids())
@pytest.mark.parametrize("quick", [False, True])
def test_shipped_grids(name: str, quick: bool, tmp_path: Path) -> None:
    grid = load_grid(name, quick)
    assert grid.file.title
    (tmp_path / "sweep.toml").write_text(grid.to_toml())
    assert load_grid(str(tmp_path / "sweep.toml")) == grid


def test_cells_of_the_small_buffers() -> None:
    cells = load_grid("small-buffers").cells
    capacities = {cell.config.replay.capacity for cell in cells}
    ratios = {cell.config.replay.ratio for cell in cells}
    assert (min(capacities), max(capacities), min(ratios), max(ratios)) == (50, 5000, 0.25, 4.0)
    assert {cell.config.replay.eviction for cell in cells} == {"fifo", "reservoir", "prioritized"}
    assert {cell.config.method for cell in cells} == {"dqn", "edql", "g-coop", "coop"}
    # What the preset says for one method holds there, and what the grid says holds over it.
    assert {cell.config.learner.optimizer for cell in cells if cell.config.method == "g-coop"} == {"adam"}
    assert {cell.config.replay.learning_starts for cell in cells} == {50}


def test_one_cell_by_name_or_number() -> None:
    grid = load_grid("paper-buffers", quick=True)
    names = [cell.name for cell in grid.cells]
    for asked, number in (("0", 0), ("23", 23), (names[7], 7)):
        (one,) = chosen(SweepOptions("paper-buffers", cell=(asked,)), grid, Path("runs"))
        assert one.cell.name == names[number]
    with pytest.raises(UsageError, match="--cell 24: not in the grid"):
        chosen(SweepOptions("paper-buffers", cell=("24",)), grid, Path("runs"))


def test_cells_share_the_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each cell on a GPU sees one; the environment of the processes says which."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,GPU-5")
    path = tmp_path / "grid.toml"
    path.write_text('methods = ["dqn"]\nseeds = [0, 1, 2, 3]\n[fixed]\nlearner.device = "cuda"\n')
    grid = load_grid(str(path))
    executor = LocalProcesses(grid.file, 4)
    seen = []
    try:
        for cell in grid.cells:
            assert executor.start(CellFolder(tmp_path, cell))
            environ = Path(f"/proc/{executor._processes[cell.name].pid}/environ")
            ends = time.monotonic() + 20
            while not (named := [one[21:] for one in environ.read_text().split("\0") if one[:21] == NAMED]):
                assert time.monotonic() < ends, "the variable is there once the program has begun"
            seen += named
    finally:
        executor.stop(0)
    assert sorted(seen) == ["3", "3", "GPU-5", "GPU-5"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("vary.replay.capcity = [5]", "replay.capcity = 5: no such field; did you mean capacity? allowed: capacity"),
        ("fixed.speed = 5", "speed = 5: no such field; did you mean seed? allowed: run"),
        ("sedes = [1]", "sedes = [1]: no such field; did you mean seeds? allowed: methods"),
        ("vary.replay.capacity = []", "vary.replay.capacity = []: must be a list of at least one"),
        ("vary.replay.capacity = 500", "vary.replay.capacity = 500: must be a list"),
        ("methods = []", "methods = []"),
        ('methods = ["sarsa"]', "'sarsa'"),
        ("seeds = [-1]", "-1"),
        ('preset = "cartpol"', "'cartpol': unknown; did you mean cartpole? allowed: "),
        ('mode = "both"', "mode = 'both'"),
        (
            "vary.replay.capacity = [50]\nfixed.replay.learning_starts = 128",
            "128: must not exceed replay.capacity = 50",
        ),
        ("vary.replay.capacity = [500, 500]", "two cells collide: both are called coop-capacity=500-seed=0"),
        ("vary.replay.ratio = [1, 1.0]", "two cells collide: coop-ratio=1-seed=0 and coop-ratio=1.0-seed=0"),
        ("seeds = [3, 3]", "two cells collide: both are called coop-seed=3"),
        ("vary.seed = [1]", "seed: list it as `seeds`"),
        ("fixed.edl.rate = 0.1\nvary.edl.rate = [0.1]", "edl.rate: both in [fixed] and in [vary]"),
        ("fixed.replay = 5", "replay = 5: must be a table"),
        ('fixed.env.id = "CartPoles-v0"', "CartPoles-v0"),
        ("fixed.actor.num_envs = 4", "actor.num_envs = 4: lockstep cells play one emulator"),
        (
            'mode = "distributed"\nfixed.learner.swap_unit = "steps"',
            "learner.swap_unit = 'steps': in lockstep runs only",
        ),
        ("a = = 1", "line 1"),
    ],
)
def test_a_bad_grid_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as caught:
        load_grid(str(path))
    printed = str(caught.value)
    assert printed.startswith(f"grid {path}: ")
    assert words in printed
    assert "\n" not in printed


def test_a_method_with_settings_of_its_own_varies_in_them(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text('methods = ["dqn", "medqn"]\nfixed.medqn.states = "real"\nfixed.medqn.epochs = 2\n')
    dqn, medqn = (cell.config for cell in load_grid(str(path)).cells)
    assert (dqn.method_settings, medqn.method_settings) == (None, MedqnSettings("real", epochs=2))
    path.write_text('methods = ["medqn"]\nvary.medqn.lambda_end = [1.0, 4.0]\n')
    cells = load_grid(str(path)).cells
    assert [cell.name for cell in cells] == ["medqn-lambda_end=1.0-seed=0", "medqn-lambda_end=4.0-seed=0"]
    assert [cell.config.method_settings.lambda_end for cell in cells] == [1.0, 4.0]
    path.write_text('methods = ["dqn", "medqn"]\nvary.medqn.epochs = [1, 2]\n')
    with pytest.raises(UsageError, match="dqn-epochs=1-seed=0 and dqn-epochs=2-seed=0 are the same run"):
        load_grid(str(path))


def test_a_grid_sets_fields_of_single_methods(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    text = 'methods = ["dqn", "coop"]\nfixed.learner.learning_rate = 0.25\n'
    path.write_text(text + "fixed.methods.coop.learner.learning_rate = 0.5\n")
    grid = load_grid(str(path))
    assert [(cell.name, cell.config.learner.learning_rate) for cell in grid.cells] == [
        ("dqn-seed=0", 0.25),
        ("coop-seed=0", 0.5),
    ]
    (tmp_path / "sweep.toml").write_text(grid.to_toml())
    assert load_grid(str(tmp_path / "sweep.toml")).cells == grid.cells
    for wrong, words in (
        ("fixed.methods.coop.learner.rate = 1", "learner.rate = 1: no such field"),
        ("fixed.methods.sarsa.gamma = 1", "methods.sarsa: no such method"),
        ("fixed.methods.coop.learner.gamma = 0.5\nvary.learner.gamma = [0.5, 0.9]", "are the same run"),
    ):
        path.write_text(text + wrong)
        with pytest.raises(UsageError, match=words):
            load_grid(str(path))


def claimed(folder: Path, text: str) -> None:
    """Assign a folder to a grid, whose cells may begin then."""
    grid = parse_grid(text, "grid")
    cells = [CellFolder(folder, cell) for cell in grid.cells]
    claim_folder(grid, cells, folder)
    for cell in cells:
        cell.path.mkdir(exist_ok=True)
        cell.prepare()


def test_a_config_that_the_user_wrote_is_not_replaced_by_a_cell(tmp_path: Path) -> None:
    claimed(tmp_path, TINY)
    held = tmp_path / "dqn-seed=0" / "config.toml"
    held.write_text(text := f"# mine\n{held.read_text()}")
    with pytest.raises(UsageError, match=r"config\.toml: not "):
        claimed(tmp_path, TINY)
    held.write_text(text := text.rpartition("# crc32")[0])
    with pytest.raises(UsageError, match=r"config\.toml: not written by a sweep"):
        claimed(tmp_path, TINY)
    assert held.read_text() == text


def test_a_grid_may_change_in_its_folder_but_not_become_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seeds in ("seeds = [0, 1]\n", "seeds = [0, 1, 2]\n"):
        claimed(tmp_path, seeds + TINY)
        assert capsys.readouterr().out == ""
    for _ in range(2):  # said when it changes
        claimed(tmp_path, "seeds = [1, 2, 3]\n" + TINY)
    said = "reports leave out what this grid has no cell of: 2 runs, such as coop-seed=0\n"
    assert capsys.readouterr().out == f"{tmp_path}: {said}"
    before = (tmp_path / "sweep.toml").read_text()
    with pytest.raises(UsageError, match=r"holds another sweep, with runs such as coop-seed=0; give another --dir"):
        claimed(tmp_path, "seeds = [4]\n" + TINY)
    assert (tmp_path / "sweep.toml").read_text() == before


def test_a_grid_that_the_user_wrote_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(text := f"# mine\n{TINY}")
    done = sweep(str(path), "--dir", str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{path}: not written by a sweep, and would be replaced; give another --dir" in done.stderr
    assert path.read_text() == text
    assert list(tmp_path.iterdir()) == [path]


def test_a_run_s_folder_takes_no_other_runs(tmp_path: Path) -> None:
    (tmp_path / "run-id").write_text("7\n")
    with pytest.raises(UsageError, match=r"--dir .*: the folder of a run; give another one"):
        claimed(tmp_path, TINY)
    with pytest.raises(UsageError, match=r"folder .*: the folder of a run; give another one"):
        tune({"methods": ["dqn"], "fixed": {"total_steps": 900}}, tmp_path, trials=1)
    assert [path.name for path in tmp_path.iterdir()] == ["run-id"]


def test_bad_flags_are_refused_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = tmp_path / "g.toml"
    grid.write_text(TINY)
    (tmp_path / "file").touch()
    held = tmp_path / "held" / "dqn-seed=0"
    held.mkdir(parents=True)
    (held / "config.toml").write_text("seed = 0\ntotal_steps = 999\n")
    for flags, words in (
        ([str(grid), "--dir", str(tmp_path / "file" / "sub")], "Not a directory"),
        ([str(grid), "--dir", str(tmp_path / "held")], "not the config of this grid's cell"),
        ([str(grid), "--quick"], "it has no table [quick]"),
        ([str(grid), "--cell", "x"], "--cell x: not in the grid"),
        ([str(grid), "--jobs", "0"], "--jobs 0: must be at least 1"),
        ([str(grid), "--jobs", "1000000"], "--jobs 1,000,000: need 62,500.0 GiB and more; this machine has"),
        ([str(tmp_path / "none.toml")], "No such file"),
        (["small-bufers"], "small-buffers"),
    ):
        monkeypatch.setattr("sys.argv", ["coop-sweep", *flags])
        with pytest.raises(SystemExit) as caught:
            main()
        printed = capsys.readouterr()
        assert (caught.value.code, printed.out) == (2, "")
        assert words in printed.err
        assert printed.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "g.toml", "held"]
    assert [path.name for path in held.parent.iterdir()] == ["dqn-seed=0"]


def test_interrupted_killed_and_started_again(tmp_path: Path) -> None:
    (tmp_path / "g.toml").write_text(TINY)
    folder = tmp_path / "d"
    flags = (str(tmp_path / "g.toml"), "--dir", str(folder), "--jobs", "1")
    first, second = folder / "dqn-seed=0", folder / "coop-seed=0"

    def until(path: Path, how: signal.Signals) -> str:
        with Command("coop-sweep", *flags) as process:
            while not (path.exists() and path.stat().st_size):
                assert process.returncode is None
                time.sleep(0.02)
            process.send_signal(how)
            return process.communicate(timeout=250)[1]

    printed = until(first / "episodes.csv", signal.SIGINT)
    assert printed.startswith("coop-sweep: error: interrupted with 0 of 2 cells finished")
    assert printed.count("\n") == 1
    assert json.loads((first / "summary.json").read_text())["exit"] == "interrupted"
    until(second / "metrics.jsonl", signal.SIGKILL)
    before = summaries(folder)["dqn-seed=0"]
    done = sweep(*flags)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("settings: preset cartpole; method: varying; gamma: 0.95; replay: capacity 300, ")
    assert "2 cells in" in done.stdout
    assert "1 of them finished before" in done.stdout
    assert summaries(folder)["dqn-seed=0"] == before
    for path in (first, second):
        log = (path / "run.log").read_text()
        assert log.count("\ncomplete: 900 steps") + log.startswith("complete: 900 steps") == 1
        episodes = list(csv.DictReader((path / "episodes.csv").read_text().splitlines()))
        assert [int(row["episode"]) for row in episodes] == list(range(len(episodes)))
        assert resolve(tomllib.loads((path / "config.toml").read_text())).replay.capacity == 300
        assert (path / "checkpoints" / "810" / "DONE").exists()


def test_a_failing_cell_does_not_stop_the_rest_and_one_that_another_process_runs_is_left_to_it(tmp_path: Path) -> None:
    (tmp_path / "g.toml").write_text(TINY.replace("900", "300"))
    broken, taken = tmp_path / "d" / "dqn-seed=0", tmp_path / "d" / "coop-seed=0"
    (broken / "metrics.jsonl").mkdir(parents=True)
    taken.mkdir()
    flags = (str(tmp_path / "g.toml"), "--dir", str(tmp_path / "d"), "--jobs", "2")
    with (taken / ".learner.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = Command("coop-sweep", *flags)
        wait_for("the failure", lambda: "\ndqn-seed=0: " in process.output()[0], 200)
        line = next(line for line in process.output()[0].splitlines() if line.startswith("dqn-seed=0: "))
        assert line.startswith("dqn-seed=0: FAILED, dqn-seed=0 ended (exit status 1): coop-lockstep: error: run dir")
        assert [path.name for path in taken.iterdir()] == [".learner.lock"]
        lock.close()
        done = process.end(250)
    assert done.returncode == 1
    assert done.stderr == "coop-sweep: error: 1 of 2 cells failed; the same command tries them again\n"
    assert "failed: dqn-seed=0: dqn-seed=0 ended (exit status 1): coop-lockstep: error: run directory" in done.stdout
    assert list(summaries(tmp_path / "d")) == ["coop-seed=0"]


def test_a_cell_that_diverged_is_listed_and_not_run_again(tmp_path: Path) -> None:
    (tmp_path / "g.toml").write_text(TINY.replace("900", "300"))
    lost = tmp_path / "d" / "dqn-seed=0"
    lost.mkdir(parents=True)
    (lost / "summary.json").write_text('{"exit": "diverged: TD errors are not finite at update 2"}')
    for _ in range(2):
        done = sweep(str(tmp_path / "g.toml"), "--dir", str(tmp_path / "d"), "--jobs", "1")
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.count("dqn-seed=0: diverged: TD errors are not finite at update 2\n") == 1
        assert done.stdout.endswith(f"all 2 cells are finished, 1 of them diverged; coop-report {tmp_path}/d\n")
        assert [path.name for path in lost.iterdir()] == ["summary.json"]


SBATCH = """#!/bin/bash
# Prints what Slurm 22.05 printed. Of an array's script it keeps what squeue prints of its tasks.
cd "$(dirname "$0")"
for script; do :; done
last=$(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\).*/\\1/p' "$script")
if ((last >= $(cat size))); then
  echo "sbatch: error: Batch job submission failed: Invalid job array specification" >&2
  exit 1
fi
job=$(($(cat job) + 1)); echo $job > job
echo "$@" >> asked
echo $job
for ((task = 0; task <= last; task++)); do echo "$job $task $script" >> queue; done
"""
SQUEUE = '#!/bin/bash\n[ "$*" = "--array --noheader --format=%F %K %o" ] && cat "$(dirname "$0")/queue"\n'
SCONTROL = """#!/bin/bash
[ "$*" = "show config" ] && echo "MailProg                = /bin/mail
MaxArraySize            = $(cat "$(dirname "$0")/size")
MaxDBDMsgs              = 0"
"""


@pytest.fixture
def slurm(tmp_path: Path) -> Path:
    """A folder with stand-ins for the programs of Slurm; `size` holds its MaxArraySize, `queue` what squeue prints."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, text in (("sbatch", SBATCH), ("squeue", SQUEUE), ("scontrol", SCONTROL)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    for name, text in (("size", "1001"), ("job", "11"), ("queue", ""), ("asked", "")):
        (folder / name).write_text(text)
    return folder


def test_what_slurm_holds_is_not_submitted_again_and_large_grids_are_split(tmp_path: Path, slurm: Path) -> None:
    (tmp_path / "g.toml").write_text(TINY.replace("[fixed]", "seeds = [0, 1, 2, 3]\n[fixed]"))
    flags, path = (str(tmp_path / "g.toml"), "--dir", str(tmp_path / "d"), "--slurm"), f"{slurm}:{os.environ['PATH']}"
    (slurm / "size").write_text("6")
    (slurm / "queue").write_text("7 0 /elsewhere/array-1.sh\n8 4294967294 /bin/true\n")
    assert sweep(*flags, path=path).stdout == "job 12: 6 cells submitted\njob 13: 2 cells submitted\n"
    assert sweep(*flags, path=path).stdout == "job 12: 6 cells queued or running\njob 13: 2 cells queued or running\n"
    queue = (slurm / "queue").read_text()
    (slurm / "queue").write_text("".join(line for line in queue.splitlines(True) if not line.startswith("12 5")))
    done = sweep(*flags, "--jobs", "3", path=path)
    assert done.stdout.splitlines()[-1] == "job 14: 1 cell submitted"
    (submitted,) = (tmp_path / "d" / "array-3.cells").read_text().splitlines()
    assert submitted == (tmp_path / "d" / "array-1.cells").read_text().splitlines()[5]
    # With --jobs, one array waits for the other.
    (slurm / "queue").write_text("")
    assert sweep(*flags, "--jobs", "3", path=path).stdout == "job 15: 6 cells submitted\njob 16: 2 cells submitted\n"
    assert (slurm / "asked").read_text().splitlines()[-1].startswith("--parsable --dependency=afterany:15 ")
    (slurm / "queue").write_text("")
    (slurm / "size").write_text("0")
    assert sweep(*flags, path=path).stderr == ("coop-sweep: error: this Slurm takes no job arrays: MaxArraySize is 0\n")


def test_several_cells_of_a_task_run_at_once_after_its_setup(tmp_path: Path, slurm: Path) -> None:
    (tmp_path / "g.toml").write_text(TINY.replace("900", "100\nreplay.learning_starts = 50"))
    folder, path = tmp_path / "d", f"{slurm}:{os.environ['PATH']}"
    setup = f"echo ready > {tmp_path / 'made'}"
    flags = (str(tmp_path / "g.toml"), "--dir", str(folder), "--slurm", "--per-task", "2", "--setup", setup)
    assert sweep(*flags, path=path).stdout == "job 12: 2 cells submitted\n"
    assert sweep(*flags, path=path).stdout == "job 12: 2 cells queued or running\n"
    script = folder / "array-1.sh"
    assert "#SBATCH --array=0-0\n#SBATCH --cpus-per-task=2\n" in script.read_text()
    task = {**os.environ, "SLURM_ARRAY_TASK_ID": "0"}
    subprocess.run(["bash", str(script)], env=task, capture_output=True, timeout=250, check=True)
    assert (tmp_path / "made").read_text() == "ready\n"
    assert sorted(summaries(folder)) == ["coop-seed=0", "dqn-seed=0"]
    assert sweep(*flags[:-4], "--per-task", "0", path=path).stderr.endswith("--per-task 0: must be at least 1\n")


def test_a_job_array_of_distributed_cells(tmp_path: Path, slurm: Path) -> None:
    """The submission is to stand-ins for Slurm; the submitted script runs in earnest, as one task would run it."""
    (tmp_path / "g.toml").write_text(f'mode = "distributed"\n{TINY.replace("900", "600")}')
    flags = (str(tmp_path / "g.toml"), "--dir", str(tmp_path / "d"), "--slurm", "--jobs", "7")
    missing = sweep(*flags, path="/nowhere")
    assert missing.returncode == 1
    assert missing.stderr == "coop-sweep: error: squeue: not found here; give the same command where Slurm is\n"
    done = sweep(*flags, path=f"{slurm}:{os.environ['PATH']}")
    assert (done.returncode, done.stdout, done.stderr) == (0, "job 12: 2 cells submitted\n", "")
    script = tmp_path / "d" / "array-1.sh"
    assert "#SBATCH --array=0-1%7\n#SBATCH --cpus-per-task=3\n" in script.read_text()
    assert "\n#SBATCH --open-mode=append\n#SBATCH --requeue\n" in script.read_text()
    assert not summaries(tmp_path / "d")
    task = {**os.environ, "SLURM_ARRAY_TASK_ID": "1"}
    subprocess.run(["bash", str(script)], env=task, capture_output=True, timeout=250, check=True)
    assert [json.loads(text)["method"] for text in summaries(tmp_path / "d").values()] == ["coop"]


def test_a_refused_array_leaves_nothing_behind(tmp_path: Path, slurm: Path) -> None:
    (tmp_path / "g.toml").write_text(TINY)
    (slurm / "scontrol").write_text("#!/bin/bash\necho 'MaxArraySize = 9'\n")
    (slurm / "size").write_text("1")
    done = sweep(
        str(tmp_path / "g.toml"), "--dir", str(tmp_path / "d"), "--slurm", path=f"{slurm}:{os.environ['PATH']}"
    )
    assert done.returncode == 1
    assert done.stderr == (
        "coop-sweep: error: sbatch: error: Batch job submission failed: Invalid job array specification\n"
    )
    assert [path.name for path in (tmp_path / "d").iterdir()] == ["sweep.toml"]
