"""A campaign of faults: kills, runs side by side, damaged files, full disks; four counts must be 0.

    python benchmarks/faults.py --folder /tmp/faults --faults 200

Each fault is done to a copy of a small study, which then is run again. A run that ends with exit
code 0 must have the numbers of an undisturbed one; any other must end with one line. Faults of a
full disk need the right to mount a tmpfs.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mlflow.pyfunc  # noqa: F401 - what is imported here, forked processes have
from kedro.framework.cli.cli import KedroCLI
from kedro.framework.startup import bootstrap_project
from kedro.io import DatasetError

import gyro_pipeline.datasets.tracked_runs
import gyro_pipeline.pipelines.assembly
import gyro_pipeline.runner  # noqa: F401
from gyro_pipeline.datasets.recordings import Recordings
from gyro_pipeline.datasets.tables import Table
from gyro_pipeline.store import relocate

ROOT = Path(__file__).parents[1]
SMALL = "only.sensor=dot,only.window_s=10,only.real_gyros=3,training.epochs=3"
REPORT = ("--pipeline=augmentation", "--env=smoke", f"--params={SMALL},execution.executor=serial")
RUN = (*REPORT[:2], f"{REPORT[2]}", "--to-nodes=evaluation.evaluate_augmentation_dot")
WORKERS = (*REPORT[:2], f"--params={SMALL},execution.workers=2", RUN[3])
OTHER = (*RUN[:2], f"{RUN[2]},virtual_gyros.turn_on_jitter_mdps=50", RUN[3])
DRAW = ("--pipeline=virtual_gyros", *OTHER[1:3])
PATIENCE_S = 900
_RUN_AFTER_DAMAGE = 0.1
STORED = (
    *("recordings.nc", "quality.csv", "allan.nc", "bias.csv", "noise.csv", "dot_truth.nc"),
    *("virtual_recordings.nc", "augmentation_windows.parquet", "augmentation_plan.csv"),
    *("augmentation_results.csv", "history.csv", "scores.csv", "errors.parquet"),
    *("running_mean_curve.parquet", "estimator.pkl"),
)


@dataclass
class Study:
    """A project's folder, and what ran in it."""

    folder: Path
    said: list[str] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)
    kept: list[dict] = field(default_factory=list)
    expected: set = field(default_factory=set)

    def start(self, arguments: Sequence[str]) -> tuple[int, Path]:
        """``kedro run`` in a process that was forked with all modules imported."""
        log = self.folder / f"log{len(list(self.folder.glob('log*')))}"
        log.touch()
        return _fork(self.folder, log, lambda: _kedro(self.folder, arguments)), log

    def end(self, pid: int, log: Path) -> int:
        """Wait for a run, and keep its exit code and what it said."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                break
            if time.monotonic() > deadline:
                os.killpg(pid, signal.SIGKILL)
            time.sleep(0.05)
        self.codes.append(os.waitstatus_to_exitcode(status))
        self.said.append(log.read_text(errors="replace"))
        return self.codes[-1]

    def run(self, arguments: Sequence[str] = RUN) -> int:
        return self.end(*self.start(arguments))

    def query(self, sql: str) -> list[tuple]:
        store = self.folder / "mlflow.db"
        if not store.exists():
            return []
        with contextlib.closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as db:
            try:
                return db.execute(sql).fetchall()
            except sqlite3.Error:
                return []

    def numbers(self) -> dict[tuple[str, str], float]:
        """The metrics of each finished run by its fingerprint and their names."""
        rows = self.query(
            "select t.value, m.key, m.value from latest_metrics m join tags t using (run_uuid) "
            "join runs r using (run_uuid) where t.key = 'fingerprint' and r.status = 'FINISHED' "
            "and r.lifecycle_stage = 'active'"
        )
        return {(fingerprint, name): value for fingerprint, name, value in rows}

    def trained(self) -> dict[str, list[str]]:
        """When the fits of each fingerprint ended, for each of its runs."""
        rows = self.query(
            "select f.value, t.value from tags t join tags f using (run_uuid) join runs r using "
            "(run_uuid) where t.key = 'trained' and f.key = 'fingerprint' and "
            "r.lifecycle_stage = 'active'"
        )
        found: dict[str, list[str]] = {}
        for fingerprint, ended in rows:
            found.setdefault(fingerprint, []).append(ended)
        return found


def _fork(folder: Path, log: Path, function: Callable[[], int]) -> int:
    """The number of a process that does something in a folder and says it to a file."""
    sys.stdout.flush()
    if pid := os.fork():
        return pid
    code = 1
    try:
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(folder)
        output = os.open(log, os.O_WRONLY | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        code = function()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _forked(folder: Path, log: Path, function: Callable[[], int]) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(_fork(folder, log, function), 0)[1])


def _kedro(folder: Path, arguments: Sequence[str]) -> int:
    sys.argv = ["kedro", "run", *arguments]
    try:
        bootstrap_project(folder)
        KedroCLI(folder).main(["run", *arguments], standalone_mode=True)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        return 1
    return 0


# faults: each changes a study, and says what it did


def flip(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def change_digit(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    digits = [place for place, byte in enumerate(content) if chr(byte) in "0123456789"]
    place = rng.choice(digits)
    content[place : place + 1] = str((int(chr(content[place])) + 1) % 10).encode()
    path.write_bytes(content)


def cut(path: Path, rng: random.Random) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: rng.randrange(len(content))])


def remove(path: Path, _rng: random.Random) -> None:
    path.unlink()


def damaged(study: Study, rng: random.Random, name: str, damage: Callable, run: bool) -> str:
    """A file is damaged, and read: it must be refused, or its run be set back."""
    path = rng.choice(sorted(study.folder.rglob(name)))
    before = path.read_bytes()
    damage(path, rng)
    if path.exists() and path.read_bytes() == before:
        flip(path, rng)
    log = study.folder / "log-read"
    log.touch()
    study.codes.append(_forked(study.folder, log, lambda: _read(study.folder, path)))
    study.said.append(log.read_text())
    if run:
        study.run(REPORT)
    else:
        path.write_bytes(before)
    return f"{damage.__name__} {name}{', then a run' * run}"


def _read(folder: Path, path: Path) -> int:
    """Load a file as stages do; 0 where it was refused, or made to be made again."""
    runs = gyro_pipeline.datasets.tracked_runs.TrackedRuns(str(folder / "mlflow.db"))
    if "mlruns" in path.parts:
        silent = all(run.finished for run in runs.load())
        print("silent" * silent, flush=True)
        return int(silent)
    kind = Recordings if path.suffix == ".nc" else Table
    try:
        kind(str(path)).load()
    except DatasetError:
        return 0
    print("silent", flush=True)
    return 1


def swapped(study: Study, rng: random.Random, name: str) -> str:
    """The artifacts of two runs change places."""
    paths = sorted((study.folder / "mlruns").rglob(name))
    one, other = rng.sample(paths, 2)
    kept = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(kept)
    study.run(REPORT)
    study.run(REPORT)
    return f"swap {name}"


def killed(study: Study, rng: random.Random) -> str:
    """A run is killed or interrupted at random times, and at last left to its end."""
    signals = []
    for _ in range(rng.randint(1, 2)):
        pid, log = study.start(rng.choice((RUN, WORKERS, REPORT)))
        time.sleep(rng.uniform(0.1, 1) ** 2 * killed.whole_s)
        signals.append(rng.choice((signal.SIGKILL, signal.SIGINT)))
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if signals[-1] == signal.SIGINT else os.kill)(pid, signals[-1])
        before = study.trained()
        code = study.end(pid, log)
        if signals[-1] == signal.SIGINT and code == 0 and "interrupted" in study.said[-1]:
            raise AssertionError("exit code 0 after Ctrl-C")
        study.kept.append(before)
    study.run()
    return f"{' '.join(s.name for s in signals)}"


killed.whole_s = 20.0


def together(study: Study, rng: random.Random, commands: Sequence[Sequence[str]]) -> str:
    """Several runs, begun within a few seconds of each other."""
    pids = []
    for command in commands:
        pids.append(study.start(command))
        time.sleep(rng.uniform(0, 5))
    for pid in pids:
        study.end(*pid)
    return f"{len(commands)} runs: {', '.join(c[0][11:] for c in commands)}"


def full(study: Study, rng: random.Random, part: str) -> str:
    """A folder is a file system that is full, and then has room."""
    folder, kb = study.folder / part, round(2 ** rng.uniform(6, 12.5))
    folder.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kb}k", "tmpfs", str(folder)]
    subprocess.run(mount, check=True)
    try:
        study.run()
        subprocess.run(["mount", "-o", "remount,size=200m", str(folder)], check=True)
        study.run()
        kept = study.folder / f"{part}.kept"
        shutil.copytree(folder, kept)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)
    shutil.rmtree(folder)  # what the mount hid
    kept.rename(folder)
    return f"{part} of {kb} kB"


def plan(rng: random.Random, count: int) -> list[tuple[str, str, Callable]]:
    """Kind, where to begin (``new`` or ``made``), and what to do."""
    faults: list[tuple[str, str, Callable]] = []
    for name in STORED:
        for damage in (flip, flip, change_digit, change_digit, cut, cut, remove):
            run = rng.random() < _RUN_AFTER_DAMAGE
            state = "made" if run else "shared"
            faults.append(
                ("damage", state, lambda s, r, n=name, d=damage, u=run: damaged(s, r, n, d, u))
            )
    for name in ("errors.parquet", "scores.csv", "estimator.pkl"):
        faults.append(("damage", "made", lambda s, r, n=name: swapped(s, r, n)))
    sides = [[RUN] * 2, [WORKERS, RUN], [RUN] * 4, [RUN, OTHER], [WORKERS, DRAW], [RUN, DRAW]]
    sides.append([RUN, OTHER, RUN, DRAW])
    for commands in sides * 2:
        start = rng.choice(("new", "empty"))
        faults.append(("together", start, lambda s, r, c=commands: together(s, r, c)))
    for part in ("data", "mlruns") * 8:
        faults.append(("full disk", "empty", lambda s, r, p=part: full(s, r, p)))
    while len(faults) < count:
        faults.append(("kill", "empty", killed))
    rng.shuffle(faults)
    return sorted(faults[:count], key=lambda fault: fault[1] != "shared")  # the quick ones first


def judge(study: Study, references: dict) -> Counter:
    """What must not be, counted."""
    counts: Counter = Counter()
    last = study.codes[-1]
    counts["tracebacks"] = sum("Traceback" in said for said in study.said)
    counts["tracebacks"] += sum(code < 0 and code != -signal.SIGKILL for code in study.codes)
    numbers = study.numbers()
    wrong = [key for key, value in numbers.items() if references.get(key, value) != value]
    counts["silent wrong numbers"] = len(wrong) + study.said[0].startswith("silent")
    counts["trained twice"] = sum(len(runs) > 1 for runs in study.trained().values())
    for before in study.kept:
        now = study.trained()
        counts["trained twice"] += sum(now.get(key, runs) != runs for key, runs in before.items())
    missing = references.keys() - numbers.keys() if last == 0 else ()
    counts["lost runs"] = len({key for key, _ in missing} & {key for key, _ in study.expected})
    counts["last run failed"] = int(last != 0)
    return counts


def prepare(folder: Path) -> Study:
    for name in ("pyproject.toml", "requirements.lock", ".telemetry"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "conf", folder / "conf", ignore=shutil.ignore_patterns("local"))
    for name in ("conf/local", "data", "src"):
        (folder / name).mkdir()
    return Study(folder)


def begin(folder: Path, state: Path | None) -> Study:
    """A study of its own, as a copy of what was kept in a state."""
    if state is None:
        folder.mkdir(parents=True)
        return prepare(folder)
    shutil.copytree(state, folder, ignore=shutil.ignore_patterns("log*"))
    if (folder / "mlflow.db").exists():
        relocate(folder / "mlflow.db", str(folder / "mlruns"))
    return Study(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.environ["GYRO_PIPELINE_CACHE"] = str(given.folder / "cache")
    made = begin(given.folder / "made", None)
    assert made.run(REPORT) == 0, made.said
    expected = set(made.numbers())
    other = begin(given.folder / "other", None)
    assert other.run(OTHER) == 0, other.said
    empty = begin(given.folder / "empty", None)
    empty.run(("--pipeline=ground_truth", *RUN[1:]))
    references = made.numbers() | other.numbers()
    states = {"new": None, "made": made.folder, "empty": empty.folder}
    began = time.monotonic()
    again = begin(given.folder / "again", empty.folder)
    again.run()
    killed.whole_s = time.monotonic() - began
    shared = begin(given.folder / "shared", made.folder)
    shutil.copy(shared.folder / "mlflow.db", made.folder / "mlflow.db.kept")
    total: Counter = Counter()
    kinds: Counter = Counter()
    rng = random.Random(given.seed)
    for number, (kind, state, fault) in enumerate(plan(rng, given.faults)):
        if state == "shared":  # it is put back as it was
            shutil.copy(made.folder / "mlflow.db.kept", shared.folder / "mlflow.db")
            study = Study(shared.folder)
        else:
            study = begin(given.folder / f"fault{number}", states[state])
        study.expected = set() if state == "shared" else expected
        try:
            what = fault(study, rng)
            counts = judge(study, references)
        except Exception:
            what, counts = traceback.format_exc(), Counter({"campaign": 1})
        kinds[kind] += 1
        total += counts
        bad = {name: count for name, count in counts.items() if count}
        print(time.strftime("%T"), number, kind, what, study.codes, json.dumps(bad), flush=True)
        if not bad and state != "shared":
            shutil.rmtree(study.folder)
    print(json.dumps({"faults": kinds, "counts": total}))


if __name__ == "__main__":
    main()
