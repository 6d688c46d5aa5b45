"""What `make bench` compares, and the ratios that it should reach."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from bench.comparison import Comparison, Subject
from bench.processor import fast_bfloat16

GRADIENT, FEEDBACK = ("dqn", "g-coop"), ("edql", "coop")


@dataclass(frozen=True)
class Target:
    """A figure to be reached: `over`'s, or its ratio to `under`'s in the same round.

    Attributes:
        comparison: its title.
        under: a subject; of several, the best; if there is none, the target is no ratio.
        bound: least figure; most if `at_most`.
    """

    comparison: str
    measure: str
    over: str
    under: tuple[str, ...]
    bound: float
    at_most: bool = False


def _updates() -> Iterator[Comparison]:
    for kind, batch in (("mlp", 32), ("minatar", 32), ("nips2013", 32), ("nature", 32), ("nature", 512)):
        subjects = _update_subjects(kind, batch, "cpu") | {"TorchRL": Subject("update_torchrl", (kind, str(batch)))}
        if batch == 32:  # on a processor, an update of 512 takes JAX more than a minute
            subjects |= {"JAX": Subject("update_jax", (kind, str(batch)), venv="jax")}
        subjects |= {f"peak {dtype}": Subject("peak", (dtype,)) for dtype in ("float32", "bfloat16")}
        title = f"update of {kind}, batch {batch}"
        yield Comparison("update", title, subjects, "Stable-Baselines3", 9 if batch == 32 else 5, 0.5)
    for batch in (32, 512):
        title = f"update of nature, batch {batch}, CUDA"
        yield Comparison("cuda", title, _update_subjects("nature", batch, "cuda"), "Stable-Baselines3")


def _update_subjects(kind: str, batch: int, device: str) -> dict[str, Subject]:
    def ours(method: str, dtype: str) -> Subject:
        return Subject("update_coop", (kind, method, str(batch), dtype, device))

    subjects = {
        "Stable-Baselines3": Subject("update_sb3", (kind, str(batch), device)),
        **{method: ours(method, "float32") for method in (*GRADIENT, *FEEDBACK)},
    }
    # Where they are slow, an update of 512 takes half a minute.
    quick = batch == 32 or device != "cpu" or fast_bfloat16()
    if kind in ("nips2013", "nature") and quick:
        subjects |= {f"{method} bfloat16": ours(method, "bfloat16") for method in ("dqn", "coop")}
    return subjects


def _tables() -> Iterator[Comparison]:
    for item in ("400B", "28KB", "400KB"):
        subjects = {
            "bare copies": Subject("table_bare", (item,)),
            "coop": Subject("table_coop", (item, "fifo", "uniform")),
            "cpprb": Subject("table_cpprb", (item, "uniform")),
            "Stable-Baselines3": Subject("table_sb3", (item,)),
            "TorchRL": Subject("table_torchrl", (item, "uniform")),
            "coop prioritized": Subject("table_coop", (item, "fifo", "prioritized")),
            "cpprb prioritized": Subject("table_cpprb", (item, "prioritized")),
        }
        yield Comparison("table", f"table of items of {item}", subjects, "cpprb", 9, 0.4)


def _service() -> Iterator[Comparison]:
    ways, bare = ("tcp", "shm"), {"bare": "copies", "bare draws": "draws"}
    subjects = {
        "Reverb": Subject("service_reverb", venv="reverb", cores=0),
        **{f"coop {way}": Subject("service_coop", (way,), cores=0) for way in ways},
        **{f"{name} {way}": Subject("service_bare", (way, bare[name]), cores=0) for name, way in product(bare, ways)},
        "coop tcp, no mirror": Subject("service_coop", ("whole",), cores=0),
        "coop router": Subject("service_coop", ("router",), cores=0),
    }
    yield Comparison("service", "replay service", subjects, "Reverb", seconds=3.0)


def _acting() -> Iterator[Comparison]:
    subjects = {
        "Stable-Baselines3": Subject("acting_sb3"),
        "gymnasium": Subject("acting_gymnasium"),
        "our loop": Subject("acting_loop", ("both",)),
        "coop-actor": Subject("acting_coop", cores=0),
        "our loop, emulation alone": Subject("acting_loop", ("emulation",)),
        "bare emulators": Subject("acting_ale"),
    }
    yield Comparison("acting", "acting, eight emulators of Breakout", subjects, "Stable-Baselines3")


def _steps() -> Iterator[Comparison]:
    minatar, period = "minatar-breakout", "4"  # steps an update, as in the whole runs of `learning`
    bare = {"bare loop of coop": Subject("steps_bare", (minatar, "coop", period))}
    for title, subjects in (
        ("cartpole-paper", _step_subjects("cartpole-paper", "1", *GRADIENT, *FEEDBACK)),
        (minatar, _step_subjects(minatar, "1", *GRADIENT, *FEEDBACK, "medqn")),
        (f"{minatar}, an update every four", _step_subjects(minatar, period, "dqn", "coop") | bare),
    ):
        yield Comparison("steps", f"lockstep steps of {title}", subjects, "Stable-Baselines3", 9, 1.0)


def _step_subjects(preset: str, period: str, *methods: str) -> dict[str, Subject]:
    ours = {method: Subject("steps_coop", (preset, method, period)) for method in methods}
    return {
        "Stable-Baselines3": Subject("steps_sb3", (preset, period)),
        "rejax": Subject("steps_rejax", (preset, period), venv="jax"),
        "JAX": Subject("steps_jax", (preset, period), venv="jax"),
        **ours,
    }


def _end_to_end() -> Iterator[Comparison]:
    for task, rounds in (("cartpole", 10), ("minatar-breakout", 5)):
        subjects = {
            "Stable-Baselines3": Subject("learn", ("sb3", task)),
            "TorchRL": Subject("learn", ("torchrl", task)),
            "rejax": Subject("learn", ("rejax", task)),
            "JAX": Subject("learn", ("jax", task)),
            "dqn lockstep": Subject("learn", ("lockstep", task, "dqn")),
            "coop lockstep": Subject("learn", ("lockstep", task)),
            "coop distributed": Subject("learn", ("distributed", task), cores=0),
        }
        yield Comparison("learning", f"learning {task}", subjects, "Stable-Baselines3", rounds, 0.0, abreast=True)


def _overheads() -> Iterator[Comparison]:
    runs = {who: Subject("runs", (who, "3000"), cores=0) for who in ("lockstep", "distributed")}
    yield Comparison("overhead", "3,000 steps of CartPole", runs, "lockstep", seconds=0.0)
    sessions = {str(count): Subject("broadcast", (str(count),), cores=0) for count in (1, 8, 32)}
    yield Comparison("overhead", "broadcast of nature's weights", sessions, "1")
    for dtype in ("float32", "bfloat16"):
        subjects = {
            "constant batch": Subject("update_coop", ("nature", "coop", "32", dtype, "cpu")),
            "in a topology": Subject("topology", ("coop", dtype), cores=0),
        }
        yield Comparison("overhead", f"updates of coop on nature, {dtype}", subjects, "constant batch", seconds=3.0)


def _start() -> Iterator[Comparison]:
    waits = {
        "import torch": "torch",
        "import coop.learner.edl": "edl",
        "coop-local to its first update": "local",
        "coop-report of 336 runs": "report",
    }
    subjects = {name: Subject("start", (what,), cores=0) for name, what in waits.items()}
    yield Comparison("start", "what users wait for", subjects, "import torch", seconds=0.0)


def _growth() -> Iterator[Comparison]:
    for part, sizes in {
        "table": (10_000, 100_000, 1_000_000),
        "emulators": (1, 10, 100),
        "actors": (1, 10, 100),
        "length": (500, 5000, 50_000),
        "runs": (3, 33, 336),
        "actions": (2, 6, 18),
    }.items():
        cores = 0 if part == "actors" else 1
        subjects = {f"{size:,}": Subject("grow", (part, str(size)), cores=cores) for size in sizes}
        once = part in ("actors", "length", "runs")  # a turn is a whole one
        rounds, seconds = (3, 0.0) if once else (7, 0.5)
        yield Comparison("growth", f"growth of {part}", subjects, f"{sizes[0]:,}", rounds, seconds, abreast=once)


COMPARISONS = (
    *_updates(),
    *_tables(),
    *_service(),
    *_acting(),
    *_steps(),
    *_overheads(),
    *_start(),
    *_growth(),
    *_end_to_end(),
)
AREAS = tuple(dict.fromkeys(comparison.area for comparison in COMPARISONS))
ON_REQUEST = "cuda"  # an area that is measured only where it is named

BATCHES, BESIDE = "batches/s alone", "batches/s beside inserts"
RIVALS = ("Stable-Baselines3", "TorchRL")
OTHERS = ("cpprb", "Stable-Baselines3", "TorchRL")
TARGETS = (
    Target("replay service", BESIDE, "coop tcp", ("Reverb",), 15.0),
    Target("replay service", BESIDE, "coop tcp", ("coop tcp, no mirror",), 3.0),
    Target("replay service", BESIDE, "coop shm", ("Reverb",), 10.0),
    Target("replay service", "inserted/s alone", "coop tcp", ("Reverb",), 10.0),
    Target("replay service", BESIDE, "coop tcp", ("bare tcp",), 0.75),
    Target("replay service", BESIDE, "coop shm", ("bare shm",), 0.75),
    Target("update of nature, batch 32", "updates/s", "coop bfloat16", ("dqn",), 1 / 1.4),
    Target("lockstep steps of cartpole-paper", "steps/s", "dqn", ("rejax",), 0.8),
    Target("lockstep steps of cartpole-paper", "steps/s", "coop", ("rejax",), 0.6),
    Target("table of items of 28KB", "sampled/s", "coop", ("bare copies",), 1 / 1.2),
    Target("table of items of 28KB", "inserted/s", "coop", OTHERS, 15.0),
    Target("table of items of 28KB", "sampled/s", "coop prioritized", ("coop",), 0.5),
    Target("table of items of 400B", "sampled/s", "coop prioritized", ("coop",), 0.5),
    Target("updates of coop on nature, float32", "updates/s", "in a topology", ("constant batch",), 0.95),
    Target("updates of coop on nature, bfloat16", "updates/s", "in a topology", ("constant batch",), 0.95),
    Target("what users wait for", "seconds", "coop-report of 336 runs", (), 10.0, at_most=True),
    Target("what users wait for", "seconds", "coop-local to its first update", (), 3.0, at_most=True),
    Target("what users wait for", "seconds", "import coop.learner.edl", (), 1.5, at_most=True),
    Target("learning cartpole", "seconds", "coop lockstep", RIVALS, 1 / 2, at_most=True),
    Target("learning minatar-breakout", "seconds", "coop lockstep", RIVALS, 1 / 3, at_most=True),
)
