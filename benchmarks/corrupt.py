"""Damages files of runs and studies, which every command then reads: `python benchmarks/corrupt.py --mutations 2000`.

Seeded mutations (a bit, a page of zeros, a cut at any byte, the same file of the run's other checkpoint, the same file
of another run) of every kind of file. Each outcome is one of

- named: a line says what is wrong, whether the command goes on without it or ends with status 1 or 2
- harmless: the result is the same, byte for byte, as of the undamaged files
- silent: the result differs, and nothing is said
- traceback, hang: of the command

and the last three must not happen; neither must a command that refuses change the files. Commands run in this process,
as that takes a twentieth of the time; of `coop-local`, what its processes read (`coop-local` itself with --processes).
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from coop.common.errors import CoopError
from coop.common.process.processes import ChildProcess, command

LIMIT = 120  # seconds for a command, on a busy machine
LIMITS = {"coop-local": 600, "coop-sweep": 600}  # whose processes wait for each other
PAGE = 4096
SHOWN = 200  # mutations between two lines of progress
RUN = ("--total-steps=260", "--replay.capacity=100", "--replay.learning-starts=40", "--network.hidden=8")
SIZED = ("--checkpoint-every=100", "--eval-every=100", "--eval-episodes=1")
MUTATIONS = ("bit", "page", "cut", "other checkpoint", "other run")
BAD = ("silent", "traceback", "hang", "changed")
# What no reader reads: pictures, logs and displays; the owner's name in a lock.
UNREAD = re.compile(r"(^|/)(tb|logs|videos|aside)/|\.png$|\.lock$|/lock$|run\.log$|\.gif$")
# Words of the lines that name damage, beside the name of the file itself.
NAMING = re.compile(
    r"passes over|can't be read|wrong checksum|damaged|is missing|incomplete|not what|belongs to another|no checkpoint|"
    r"not a packed study|another run's|a kill leaves it"
)


class Hang(Exception):
    """A command has not ended in time."""


@dataclass(frozen=True)
class Reader:
    """A command that reads a copy of a subject. arguments: {} is the copy, {out} a new folder, {base} the original.

    result: files whose bytes are its result, in place of what it prints: patterns below the copy and {out}.
    same: of what it prints, what is the same each time, if the rest is not. share: of the mutations, beside others'.
    """

    name: str
    arguments: tuple[str, ...]
    result: tuple[str, ...] = ()
    same: str = ""
    share: int = 3


RESUMED = ("episodes.csv",)
REPORTED = ("out/*.csv", "out/*.md")
LOCKSTEP = (
    Reader("coop-lockstep", ("--resume", "--run-dir", "{}", "--total-steps", "300"), RESUMED),
    Reader("coop-eval", ("{}", "--episodes", "1")),
    Reader("coop-export", ("{}", "--out", "{out}"), ("out/*.safetensors",)),
    Reader("coop.load", ("{}",)),
)
DISTRIBUTED = (
    Reader("coop-reexecute", ("{}",)),
    Reader("coop-eval", ("{}", "--episodes", "1")),
    Reader("restore", ("{}",)),
)
STUDY = (
    Reader("coop-report", ("{}", "--out", "{out}"), REPORTED, share=1),  # figures, processes
    Reader("coop-report --curves", ("{}", "--curves", "{out}"), ("out/*/*.png",)),
    Reader("coop-sweep", ("{base}.toml", "--dir", "{}", "--jobs", "1"), ("*/episodes.csv",), share=1),
)
PACKED = (
    Reader("coop-report", ("{}/study.parquet", "--out", "{out}"), REPORTED),
    Reader("coop-report --curves", ("{}/study.parquet", "--curves", "{out}"), ("out/*/*.png",)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", action="store_true", help="coop-local too, in processes: some seconds each")
    parser.add_argument("--only", default="", help="subject/reader that contains this")
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        subjects = prepare(Path(folder))
        if options.processes:
            flags = ("--resume", "--run-dir", "{}", "--total-steps", "300", "--actors", "1")
            # Its processes never play the same steps twice; `restore` compares what they begin with.
            local = Reader("coop-local", flags, same=r"resuming from checkpoint \d+|complete: \d+ steps")
            subjects["distributed"] = (*subjects["distributed"], local)
        sys.exit(corrupt(Path(folder), subjects, options.mutations, random.Random(options.seed), options.only))


def prepare(folder: Path) -> dict[str, tuple[Reader, ...]]:
    """Make the subjects and others of their kind; return the readers of each."""
    for name, seed in (("lockstep", "0"), ("lockstep-other", "1")):
        call("coop-lockstep", *RUN, *SIZED, f"--seed={seed}", f"--run-dir={folder / name}")
    for name, seed in (("distributed", "0"), ("distributed-other", "1")):
        flags = (*RUN, *SIZED[:1], f"--seed={seed}", f"--run-dir={folder / name}", "--actors=1")
        call("coop-local", *flags, "--replay.journal", "--replay.journal-keep")
    for name, seeds in (("study", "[0, 1]"), ("study-other", "[2, 3]")):
        fixed = "[fixed]\ntotal_steps = 600\nnetwork.hidden = [8]\n"
        (folder / f"{name}.toml").write_text(f'preset = "cartpole"\nmethods = ["dqn"]\nseeds = {seeds}\n{fixed}')
        call("coop-sweep", f"{folder / name}.toml", "--dir", str(folder / name), "--jobs", "2")
    for name in ("study",):  # of a packed study alone, another one is no damage
        (folder / name.replace("study", "packed")).mkdir()
        packed = folder / name.replace("study", "packed") / "study.parquet"
        call("coop-report", str(folder / name), "--pack", str(packed))
    return {"lockstep": LOCKSTEP, "distributed": DISTRIBUTED, "study": STUDY, "packed": PACKED}


def call(name: str, *flags: str) -> None:
    """Run a command in a process; exits if it fails."""
    process = ChildProcess(name, command(name, *flags), Path("calls.log"))
    process.start()
    process.end(LIMITS["coop-local"])
    if process.exit_status():
        sys.exit(process.why())


def corrupt(
    folder: Path, subjects: dict[str, tuple[Reader, ...]], count: int, rng: random.Random, only: str = ""
) -> int:
    """Damage and read; print the table of outcomes; return the exit status."""
    plans = [(subject, reader) for subject, readers in subjects.items() for reader in readers]
    plans = [plan for plan in plans if only in f"{plan[0]}/{plan[1].name}"]
    expected = {plan: read(folder / plan[0], plan[1]) for plan in plans}
    turns = [plan for turn in range(Reader.share) for plan in plans if turn < plan[1].share]
    for (subject, reader), outcome in expected.items():
        if outcome.status:
            sys.exit(f"{subject}, {reader.name}, undamaged: {outcome.text}")
    tally: Counter[tuple[str, str, str]] = Counter()
    failures = 0
    began = time.monotonic()
    for number in range(count):
        plan = subject, reader = turns[number % len(turns)]
        file, mutation, change = choose(folder, subject, rng)
        got = read(folder / subject, reader, change)
        verdict = judge(expected[plan], got, file)
        tally[f"{subject}: {kind_of(file)}", reader.name, verdict] += 1
        if verdict in BAD:
            failures += 1
            print(f"{verdict}: {subject}/{file}, {mutation}; {reader.name}: {got.text[-1500:]}", flush=True)
        if (number + 1) % SHOWN == 0 and number + 1 < count:
            print(f"{number + 1:,} of {count:,}: {failures} silent, traceback, hang or changed", flush=True)
    print(table(tally))
    print(f"{count:,} mutations in {time.monotonic() - began:.0f} s: {failures} silent, traceback, hang or changed")
    return 1 if failures else 0


def choose(folder: Path, subject: str, rng: random.Random) -> tuple[str, str, Callable[[Path], None]]:
    """A file of a subject, a mutation that applies to it, and the function that makes it in a copy."""
    base = folder / subject
    files = sorted(str(path.relative_to(base)) for path in base.rglob("*") if path.is_file())
    kinds: dict[str, list[str]] = {}
    for each in files:
        if not UNREAD.search(each) and (base / each).stat().st_size:
            kinds.setdefault(kind_of(each), []).append(each)
    file = rng.choice(kinds[rng.choice(sorted(kinds))])
    content = (base / file).read_bytes()
    others = {"other checkpoint": _other_checkpoint(base, file), "other run": folder / f"{subject}-other" / file}
    possible = [name for name in MUTATIONS if name not in others or (others[name] and _differs(others[name], content))]
    mutation = rng.choice(possible)
    place = rng.randrange(len(content))
    if mutation == "bit":
        data = bytearray(content)
        data[place] ^= 1 << rng.randrange(8)
    elif mutation == "page":
        start = place - place % PAGE
        data = bytearray(content)
        data[start : start + PAGE] = bytes(len(data[start : start + PAGE]))
    elif mutation == "cut":
        data = bytearray(content[:place])
    else:
        other = others[mutation]
        assert other is not None
        data = bytearray(other.read_bytes())
    detail = f"{mutation} at byte {place:,} of {len(content):,}" if mutation in MUTATIONS[:3] else mutation
    return file, detail, lambda copy: (copy / file).write_bytes(bytes(data)) and None


def _other_checkpoint(base: Path, file: str) -> Path | None:
    found = re.match(r"(.*checkpoints/)(\d+)(/.*)", file)
    if found is None:
        return None
    numbers = [path.name for path in (base / found[1]).iterdir() if path.name != found[2]]
    return base / f"{found[1]}{numbers[0]}{found[3]}" if numbers else None


def _differs(path: Path | None, content: bytes) -> bool:
    return path is not None and path.exists() and path.read_bytes() != content


def kind_of(file: str) -> str:
    """The kind of a file: its path without numbers and the names of cells."""
    return re.sub(r"^[^/]*=[^/]*/", "CELL/", re.sub(r"\d+", "N", re.sub(r"[a-z_]+\.npy", "*.npy", file)))


@dataclass(frozen=True)
class Outcome:
    """What a command did. digest: of its result. status: None for a traceback, -1 for a hang."""

    status: int | None
    text: str
    digest: str
    changed: tuple[str, ...] = ()


def read(base: Path, reader: Reader, change: Callable[[Path], None] = lambda copy: None) -> Outcome:
    """Let a command read a copy of a subject, which is changed before."""
    work = base.parent / "work"
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(base, work / "copy")
    change(work / "copy")
    before = contents(work / "copy")
    arguments = [each.format(work / "copy", out=work / "out", base=base) for each in reader.arguments]
    out = io.StringIO()
    status: int | None = 0
    limit = alarm(LIMITS.get(reader.name, LIMIT))
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), limit as late:
            start(reader.name, arguments)
    except SystemExit as left:
        status = left.code if isinstance(left.code, int) else 1
    except Hang:
        pass
    except CoopError as error:  # of the Python API
        out.write(f"error: {error}")
        status = 2
    except BaseException:
        out.write(traceback.format_exc())
        status = None
    if late:  # the command may have taken Hang for its own failure
        status = -1
    printed = steady(out.getvalue())
    repeated = " ".join(re.findall(reader.same, printed)) if reader.same else printed
    result = hashlib.sha256(repeated.encode() if not reader.result else b"")
    for pattern in reader.result:
        root = work if pattern.startswith("out/") else work / "copy"
        for path in sorted(root.glob(pattern)):
            if path.is_file():
                result.update(f"{path.relative_to(work)}".encode() + path.read_bytes())
    after = contents(work / "copy")
    changed = tuple(name for name in before if status == 2 and after.get(name) != before[name])
    return Outcome(status, out.getvalue(), result.hexdigest(), changed)


def start(name: str, arguments: list[str]) -> None:
    """Run a command, or what is read by a part of one, in this process."""
    if name == "coop.load":
        return load(Path(arguments[0]))
    if name == "restore":
        return restore(Path(arguments[0]))
    if name == "coop-local":
        import subprocess  # noqa: PLC0415 (its processes can't be of this one)

        pipe = subprocess.PIPE
        with subprocess.Popen(
            command(name, *arguments), stdout=pipe, stderr=pipe, text=True, start_new_session=True
        ) as process:
            try:
                out, err = process.communicate()
            except Hang:
                os.killpg(process.pid, signal.SIGKILL)  # its roles too
                raise
        print(out, err)
        if "Traceback" in out + err:
            raise RuntimeError(err)
        sys.exit(process.returncode)
    (script,) = entry_points(group="console_scripts", name=name.split(maxsplit=1)[0])
    sys.argv = [name.split(maxsplit=1)[0], *arguments]
    script.load()()
    return None


def load(path: Path) -> None:
    """What the Python API reads of a run."""
    import coop  # noqa: PLC0415 (torch takes seconds)

    run = coop.load(path)
    for table in (run.episodes, run.metrics.drop(columns="time"), run.evaluations.drop(columns="seconds")):
        print(hashlib.sha256(table.to_csv().encode()).hexdigest())
    print({name: value for name, value in (run.summary or {}).items() if name != "wall_seconds"})
    print(run.checkpoint().networks[0].snapshot().sum(), run.config)


def restore(path: Path) -> None:
    """What `coop-local --resume` reads: its own check, the learner's state, the table and the journal."""
    from coop.common.envs.make import env_spec  # noqa: PLC0415
    from coop.learner.roster import Roster  # noqa: PLC0415
    from coop.records.learner_checkpoints import load_learner  # noqa: PLC0415
    from coop.records.reading import read_run_config  # noqa: PLC0415
    from coop.records.resumption import Start, go_back  # noqa: PLC0415
    from coop.records.run_ids import read_run_id  # noqa: PLC0415
    from coop.replay.core import ReplayCore  # noqa: PLC0415
    from coop.replay.persistence.checkpoints import ReplayCheckpoints  # noqa: PLC0415
    from coop.replay.persistence.recovery import recover  # noqa: PLC0415

    config = read_run_config(path)
    found, notices = Start(resume=True).prepare(path, replay=True, load=load_learner)
    print(*notices, sep="\n")
    assert found.newest is not None
    run_id, core = read_run_id(path), ReplayCore(config, env_spec(config.env))
    Roster(path, run_id=run_id)
    first, text = ReplayCheckpoints(path, run_id).restore(core, found.newest.number)
    _, lines = recover(core, path / "journal", first, run_id)
    print(text, *lines, sep="\n")
    go_back(found, found.newest.number)
    print(found.newest.state["agent"]["updates"], core.table.inserted, core.drawn, core.lost)
    batch = core.table.sample(32)
    print(hashlib.sha256(batch.frames.tobytes() + batch.ids.tobytes()).hexdigest())


@contextlib.contextmanager
def alarm(seconds: int) -> Iterator[list[Hang]]:
    """Raise Hang after a time, and put it into the list; restore the signals' handlers, which commands set."""
    raised: list[Hang] = []

    def handle(number: int, frame: Any) -> None:  # noqa: ANN401 (a frame)
        raised.append(Hang())
        raise raised[-1]

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGALRM, handle)
    signal.alarm(seconds)
    try:
        yield raised
    finally:
        signal.alarm(0)
        for number, handler in handlers.items():
            signal.signal(number, handler)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file that is not only shown, logged or locked."""
    names = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in names.items() if not UNREAD.search(name)}


def steady(text: str) -> str:
    """The output without times and the names of temporary folders."""
    return re.sub(r"\d+(\.\d+)? s\b|\d\d:\d\d:\d\d", "", text)


def judge(expected: Outcome, got: Outcome, file: str) -> str:
    """The kind of an outcome."""
    if got.status in (None, -1) or "Traceback (most" in got.text:
        return "hang" if got.status == -1 else "traceback"
    if got.changed:
        return "changed"
    known = set(steady(expected.text).splitlines())
    said = "\n".join(line for line in steady(got.text).splitlines() if line not in known)
    names = file in said or Path(file).name in said or NAMING.search(said)
    if names or (got.status and said):
        return "named"
    return "harmless" if got.digest == expected.digest and not got.status else "silent"


def table(tally: Counter[tuple[str, str, str]]) -> str:
    """The outcomes by kind of file and reader, in Markdown."""
    verdicts = ("named", "harmless", *BAD)
    lines = [f"| file | read by | {' | '.join(verdicts)} |", f"| --- | --- |{' ---: |' * len(verdicts)}"]
    for file, reader in sorted({(file, reader) for file, reader, _ in tally}):
        counts = [str(tally[file, reader, verdict]) for verdict in verdicts]
        lines.append(f"| {file} | {reader} | {' | '.join(counts)} |")
    sums = [str(sum(count for (_, _, each), count in tally.items() if each == verdict)) for verdict in verdicts]
    return "\n".join([*lines, f"| all | | {' | '.join(sums)} |"])


if __name__ == "__main__":
    main()
