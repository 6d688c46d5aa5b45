"""Console commands, each in a process of its own, forked where torch has been imported: a cold start takes seconds."""

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path

TESTS = str(Path(__file__).parent)
_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(
    ["actors.process", "experiments.evaluation", "experiments.lockstep_run", "learner.process"]
)


def run_command(
    name: str,
    *flags: str | Path,
    cwd: Path | None = None,
    environment: Mapping[str, str] | None = None,
    timeout: float = 120,
    check: bool = False,
) -> subprocess.CompletedProcess[str]:
    """What `subprocess.run` does with the command's script, its output captured as text.

    environment: all variables; those of this process if None. check: raise CalledProcessError at another status than 0.
    """
    arguments = [name, *map(str, flags)]
    variables = dict(os.environ if environment is None else environment)
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, stream) for stream in ("out", "err")]
        process = _SERVER.Process(
            target=_run, args=(arguments, str(cwd or Path.cwd()), variables, list(map(str, files)))
        )
        process.start()
        process.join(timeout)
        expired = process.exitcode is None
        if expired:
            process.kill()
            process.join()
        out, err = (file.read_text(encoding="utf-8") if file.exists() else "" for file in files)
    if expired:
        raise subprocess.TimeoutExpired(arguments, timeout, out, err)
    status = process.exitcode
    assert status is not None
    if check and status:
        raise subprocess.CalledProcessError(status, arguments, out, err)
    return subprocess.CompletedProcess(arguments, status, out, err)


def _run(arguments: Sequence[str], cwd: str, environment: Mapping[str, str], files: Sequence[str]) -> None:
    for number, file in enumerate(files, 1):
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT)
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:] = [place for place in sys.path if not place.startswith(TESTS)]
    sys.argv = list(arguments)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    (script,) = entry_points(group="console_scripts", name=arguments[0])
    script.load()()
