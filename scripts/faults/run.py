#!/usr/bin/env python3
"""Injects faults into every writing system call of every command that writes files, and checks the files afterwards.

    .venv/bin/python scripts/faults/run.py [--short] [--only OPERATION ...]

Each operation runs without faults first, under inject.c, which records its calls. Then, for every call and every kind
of fault, it runs again from the same state, in which older files exist where it writes. Afterwards
  - it must have ended by itself, without a signal or a panic: with all files new, or one sentence that names the file;
  - every file, and every folder that is a unit, must be the old one or the new one;
  - the same command without faults must end bit-identically to the first run, and leave no other files.
Prints a Markdown table, and every failure with the options that reproduce it. --short runs a fixed sample, in a minute.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.tensorflow_stub.errors import DataLossError, OutOfRangeError
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import PyRecordReader_New

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
PROGRAM = REPOSITORY / "target/release/globalsplat"
# (kind, sticky) of the faults of each group of calls, as in inject.c. A persistent error of all calls ("any", a lost
# disk) leaves the same state as a crash.
REFUSED = [("ENOSPC", 0), ("ENOSPC", 1), ("EIO", 0), ("EIO", 1), ("EINTR", 0)]
FAULTS = {
    "write": [*REFUSED, ("short", 0), ("short", 1), ("torn", 0), ("torn", 1), ("torn-EIO", 0)],
    "truncate": REFUSED,
    "fsync": REFUSED,
    "open": REFUSED,
    "mkdir": REFUSED,
    "rename": [*REFUSED, ("ENOSPC", 2)],
    "link": REFUSED,
    "remove": [("EIO", 0), ("EIO", 1)],
    "any": [("EIO", 1)],
}
# Calls that must be repeated after EINTR. Linux doesn't interrupt the others on a local disk.
INTERRUPTIBLE = {"write", "truncate", "fsync", "open"}
# Maximum number of failing calls per group and operation, evenly spaced.
MAX_CALLS = 60
# Number of faults with --short: of an operation that waits for free disk space, and of any other.
SHORT_OF_RUNS, SHORT_OF_OTHERS = 10, 3
# Timeout of a command, in seconds.
TIMEOUT = 30
# Lines on standard error that are not error messages.
NOTICE = re.compile(
    "training paused: .* when there is disk space$|disk space is available again: training resumes$|.*the previous checkpoint is used$"
    "|.*the best checkpoint is determined again$|left out: lpips_|.* pixels that the model sees$"
)
# Names of temporary files and folders.
TEMPORARY = re.compile(r"(^|/)\.[^/]+\.globalsplat-(partial(-\d+)?|old)(/|$)")
# JSON fields that differ from run to run: times, rates and memory.
VOLATILE = re.compile(r"(^|_)seconds?(_|$)|peak_memory")


def plain(text):
    """Replaces names of temporary files and folders in `text` with their final names."""
    text = re.sub(r"/\.([^/ ]+?)\.globalsplat-(partial(-\d+)?|old)(?=[/ :]|$)", r"/\1", text)
    return re.sub(r"/globalsplat-probe", "", text)


def steady(value):
    """Returns a JSON value without the fields that differ from run to run."""
    if isinstance(value, dict):
        return {key: steady(of) for key, of in value.items() if not VOLATILE.search(key)}
    return [steady(of) for of in value] if isinstance(value, list) else value


# Files that an operation leaves on disk.


def events(path):
    """Yields the step and a hash of every TensorBoard event, without times; for SessionLog.START, its step and None.

    Raises DataLossError if a record is truncated or damaged.
    """
    reader = PyRecordReader_New(str(path))
    while True:
        try:
            reader.GetNext()
        except OutOfRangeError:
            return
        event = Event.FromString(reader.record())
        event.ClearField("wall_time")
        for value in event.summary.value:
            if value.tag == "train/samples_per_second":
                value.ClearField("simple_value")
        if event.HasField("session_log"):
            yield event.step, None
        elif not event.HasField("file_version"):
            yield event.step, hashlib.sha1(event.SerializeToString()).hexdigest()


class Tree:
    """The files below a folder by name: a hash, or the records of a log that grows. Temporary files are kept apart."""

    def __init__(self, folder):
        self.files: dict[str, str | tuple[str, ...]] = {}
        self.temporary, self.broken = {}, []
        logged = []
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder).as_posix()
            if TEMPORARY.search(name):
                self.temporary[name] = path.is_file() and hashlib.sha1(path.read_bytes()).hexdigest()
            elif path.is_dir() or path.name in (".lock", "stdout"):
                continue
            elif path.parent.name == "tensorboard":
                try:
                    logged.extend(events(path))
                except DataLossError:
                    self.broken.append(f"{name} has a truncated or damaged record")
            elif path.name == "metrics.jsonl":
                lines = path.read_text().split("\n")
                if lines.pop():
                    self.broken.append(f"{name} ends within a line")
                self.files[name] = tuple(json.dumps(steady(json.loads(line))) for line in lines)
            else:
                self.files[name] = hashlib.sha1(path.read_bytes()).hexdigest()
        # The events that TensorBoard shows: a start discards events of later steps, and duplicates are shown once.
        shown = {}
        for step, event in logged:
            if event is None:
                shown = {of: None for of in shown if of[0] < step}
            else:
                shown[step, event] = None
        if (folder / "tensorboard").is_dir() or (folder / "out/tensorboard").is_dir():
            self.files["tensorboard"] = tuple(shown)

    def digest(self):
        return repr((sorted(self.files.items()), sorted(self.temporary.items()), self.broken))

    def units(self, unit_of):
        units = {}
        for name, value in self.files.items():
            units.setdefault(unit_of(name), {})[name] = value
        return units

    def differs(self, new):
        """Returns the differences from `new`, the tree that a run without faults leaves."""
        names = [name for name in {**self.files, **new.files} if self.files.get(name) != new.files.get(name)]
        wrong = self.broken + [f"{name} isn't the new one" for name in sorted(names)]
        return wrong + [f"{name} is left" for name in sorted(self.temporary)]

    def mixes(self, trees, unit_of, crashed):
        """Returns the units that are neither old nor new.

        `trees` are the old tree, those between, and the new one. After a crash, an old folder may still have the
        temporary name that it was renamed to while being replaced.
        """
        of = [tree.units(unit_of) for tree in trees]
        wrong = list(self.broken)
        units = self.units(unit_of)
        for unit, files in units.items():
            known = [tree[unit] for tree in of if unit in tree]
            value, end = files.get(unit), of[-1].get(unit, {}).get(unit)
            grows = isinstance(value, tuple) and isinstance(end, tuple) and end[: len(value)] == value
            if files not in known and not grows:
                wrong.append(f"{unit} is neither old nor new")
        old = [(name, value) for name, value in self.temporary.items() if ".globalsplat-old/" in name and value]
        moved = {plain("/" + name)[1:]: value for name, value in old}
        for unit, files in of[0].items():
            lies_beside = crashed and all(moved.get(name) == value for name, value in files.items())
            if unit in of[-1] and unit not in units and not lies_beside:
                wrong.append(f"{unit} is gone")
        checkpoints = [any("checkpoints/" in unit for unit in tree) for tree in (of[0], units)]
        return wrong + ["all checkpoints are gone"] * (checkpoints == [True, False])


# The operations.


def whole_checkpoint(name):
    return name.rsplit("/", 1)[0] if name.startswith(("checkpoints/", "best/")) else name


class Operation:
    """A command, the state that it starts from, and the states that it may leave."""

    def __init__(self, bench, name, arguments, unit_of=str, waits=False, into=None, once=False):
        self.bench, self.name, self.unit_of, self.waits, self.into = bench, name, unit_of, waits, into
        self.once = once
        self.arguments = [str(argument) for argument in arguments]
        self.old = bench.folder / "old" / name.replace(" ", "_").replace(",", "").replace("/", "_")
        self.old.mkdir(parents=True)
        self.between = []

    def age(self, keep=(), drop=()):
        """Starts from older files with other contents where the command writes; keeps `keep` and removes `drop`."""
        self.reset()
        done = self.bench.run(self.arguments, into=self.into)
        assert done.code == 0, done.errors
        for path in [path for path in self.bench.out.rglob("*") if path.is_file()]:
            name = path.relative_to(self.bench.out).as_posix()
            if name in drop:
                path.unlink()
            elif name not in keep:
                path.write_bytes(b"old\n" + path.read_bytes())
        self.take()
        return self

    def take(self):
        """Starts from the files that are in out/ now."""
        shutil.rmtree(self.old)
        shutil.copytree(self.bench.out, self.old)
        return self

    def reset(self):
        shutil.rmtree(self.bench.out, ignore_errors=True)
        shutil.copytree(self.old, self.bench.out)

    def undisturbed(self):
        """Runs the command without faults and records its calls, its output and the files that it leaves."""
        self.reset()
        old = Tree(self.bench.out)
        done = self.bench.run(self.arguments, into=self.into)
        assert done.code == 0 and not done.sentence, done.errors
        self.new, self.output, self.calls = Tree(self.bench.out), done.output, done.calls
        self.trees = [old, *self.between, self.new]
        assert not self.new.differs(self.new) and self.new.files != old.files, self.name
        self.ends = {}

    def names(self, done):
        """Returns `True` if the message names a file on which a call failed, or a folder that was to be removed."""
        if self.into and re.search("stdout|standard output", done.sentence):
            return True
        hit = [(group, Path(file)) for failed, group, file in done.calls if failed]
        names = [file for _, file in hit]
        names += [of for group, file in hit if group == "remove" for of in file.parents if self.bench.out in of.parents]
        return any(plain(str(name)) in plain(done.sentence) for name in names)

    def faults(self):
        """Returns (group, n, kind, sticky) for every kind of fault of evenly spaced calls of each group."""
        count = Counter(group for _, group, _ in self.calls) | Counter(any=len(self.calls))
        chosen = []
        for group, faults in FAULTS.items():
            numbers = {1 + i * (count[group] - 1) // (MAX_CALLS - 1) for i in range(MAX_CALLS)} if count[group] else ()
            chosen += [(group, n, *fault) for n in sorted(numbers) for fault in faults]
        return chosen

    def again(self):
        """Runs the same command again without faults and returns the errors. Results are cached by initial state."""
        state = Tree(self.bench.out).digest()
        if state not in self.ends:
            done = self.bench.run(self.arguments, into=self.into)
            wrong = Tree(self.bench.out).differs(self.new)
            if done.code != 0:
                wrong.append(f"it ends with {done.code}: {done.errors.strip()}")
            self.ends[state] = wrong
        return [f"second run: {what}" for what in self.ends[state]]


class Done:
    """Result of a run: exit code or None, standard output and error, calls (failed, group, file)."""

    def __init__(self, code, output, errors, calls):
        self.code, self.output, self.errors, self.calls = code, output, errors, calls
        with suppress(ValueError):
            self.output = steady(json.loads(output))
        self.sentence = "\n".join(line for line in errors.splitlines() if not NOTICE.match(line))
        self.hit = [file for failed, _, file in calls if failed]


class Bench:
    """The working folder: in/ is only read, and faults are injected in out/."""

    def __init__(self, folder):
        self.folder = folder
        self.inputs, self.out, self.log = folder / "in", folder / "out", folder / "calls"
        self.library = folder / "inject.so"
        flags = ["-Wall", "-Wextra", "-O1", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, "-o", self.library, HERE / "inject.c", "-ldl"], check=True)
        for path in (self.inputs, self.out, folder / "bin"):
            path.mkdir()
        # A fake encoder is enough to test how the program writes videos. Without LPIPS weights, scoring is fast.
        encodes = 'case $* in *-encoders*) echo libx264; exit;; esac\nfor out; do :; done\nexec cat > "$out"\n'
        (folder / "bin/ffmpeg").write_text(f"#!/bin/sh\n{encodes}")
        (folder / "bin/ffmpeg").chmod(0o755)
        path = f"{folder / 'bin'}:{os.environ.get('PATH', '')}"
        ours = {"PATH": path, "OMP_NUM_THREADS": "1", "GLOBALSPLAT_WEIGHTS": str(folder / "none")}
        self.environment = dict(os.environ) | ours

    def make(self, *arguments):
        subprocess.run([PROGRAM, *map(str, arguments)], check=True, capture_output=True, env=self.environment)

    def run(self, arguments, fault=None, stop_when_waiting=False, into=None):
        """Runs the program. `fault` is (group, n, kind, sticky); `into` is a file that gets standard output."""
        self.log.unlink(missing_ok=True)
        ours = {"LD_PRELOAD": self.library, "FAULT_ROOT": self.out, "FAULT_LOG": self.log}
        if fault:
            ours |= zip(["FAULT_CALL", "FAULT_N", "FAULT_KIND", "FAULT_STICKY"], fault, strict=True)
        environment = self.environment | {key: str(value) for key, value in ours.items()}
        output, errors = self.folder / "output", self.folder / "errors"
        with (into or output).open("wb") as out, errors.open("wb") as err:
            process = subprocess.Popen([PROGRAM, *arguments], stdout=out, stderr=err, env=environment)
            begun, code = time.monotonic(), None
            while code is None and time.monotonic() - begun < TIMEOUT:
                if stop_when_waiting and b"training paused" in errors.read_bytes():
                    process.send_signal(signal.SIGTERM)
                    stop_when_waiting = False
                with suppress(subprocess.TimeoutExpired):
                    code = process.wait(0.02 if stop_when_waiting else TIMEOUT)
            if code is None:
                process.kill()
                process.wait()
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        calls = [(line[0] == "!", *line[2:].split(" ", 1)) for line in lines]
        return Done(code, "" if into else output.read_text(), errors.read_text(), calls)


def make_rooms(folder, scenes, frames, size):
    """Writes captures of synthetic rooms with their splats."""
    program = REPOSITORY / "target/release/examples/make_rooms"
    if not program.exists():
        sys.exit(f"{program} is missing: run cargo build --release --examples")
    subprocess.run([program, folder, *map(str, (scenes, frames, size))], check=True)


def operations(bench, only):
    """Yields the operations, on synthetic scenes and weights that the program creates, with the configuration of
    tests/common/program.rs."""
    inputs, out = bench.inputs, bench.out
    source = (REPOSITORY / "tests/common/program.rs").read_text()
    config = source.split('TINY_CONFIG: &str = r#"')[1].split('"#')[0]
    rooms, room = inputs / "rooms", inputs / "rooms/room_000"
    make_rooms(rooms, 2, 9, 40)
    tiny, weights = inputs / "tiny.toml", inputs / "tiny.safetensors"
    config = config.replace("[data]", f"[data]\ncaptures = [{json.dumps(str(room))}]")
    tiny.write_text(config + "validate_every = 2\n")
    bench.make("export", "--config", tiny, "--out", weights)
    splat = room / "truth.ply"
    frames = {"context": [0, 2, 4], "target": [1, 3]}
    index, splats = inputs / "index.json", inputs / "splats"
    index.write_text(json.dumps({"room_000": frames, "room_001": frames}))
    splats.mkdir()
    for name in ("room_000", "room_001"):
        shutil.copy(rooms / name / "truth.ply", splats / f"{name}.ply")
    sweep = ["eval", "--splat", splats, "--data", rooms, "--index", index, "--json", "--out"]
    bench.make(*sweep, inputs / "evaluation")

    train = ["train", "--config", tiny, "--out", out, "--json"]
    export = ["export", "--config", tiny, "--out", out / "model.safetensors", "--json"]
    reconstruct = ["reconstruct", "--weights", weights, "--scene", room, "--out", out / "room.ply", "--json"]
    quick = ["--views", 3, "--size", "24x24", "--gaussians", 400, "--steps", 4]
    refine = ["refine", "--scene", room, *quick, "--out", out / "room.ply", "--local-origin"]
    refine += ["--contact-sheet", out / "sheet.png", "--json"]
    far = inputs / "far.ply"
    shutil.copy(splat, far)
    (inputs / "far.ply.origin.json").write_text(json.dumps({"origin": [5e6, 4e5, 100.0]}))
    convert = ["convert", far, out / "far.spz", "--local-origin", "--json"]
    score = ["eval", "--splat", splat, "--scene", room, "--json", "--contact-sheet", out / "sheet.png"]
    report = ["report", inputs / "evaluation", "--out", out / "report.html", "--json"]
    orbit = ["render", "--splat", splat, "--size", "24x24", "--orbit", "--frames", 3, "--json", "--out"]

    def training(name, stopped):
        """Trains from the start, or resumes a run that failed in its fourth step, with a checkpoint of step 2."""
        op = Operation(bench, name, train, whole_checkpoint, waits=True)
        written = [file for _, group, file in bench.run(op.arguments).calls if group == "write"]
        at = [n for n, file in enumerate(written, 1) if file.endswith("/metrics.jsonl")]
        for line in (8, 5):
            op.reset()
            assert bench.run(op.arguments, ("write", at[line - 1], "EIO", 0)).code == 1
            op.between.append(Tree(out))
        return op.take() if stopped else op

    def packed(name):
        # Scenes of more than a megabyte each, so that each chunk has one scene.
        make_rooms(inputs / "large", 2, 9, 256)
        command = ["pack", inputs / "large", "--out", out, "--chunk-size", 1, "--json"]
        # Existing chunks are never replaced, so start from the state of an interrupted run.
        bench.make(*command)
        (out / "000001.torch").unlink()
        (out / "index.json").unlink()
        return Operation(bench, name, command, once=True).take()

    def filmed(name):
        more = ["--depth", "--contact-sheet", out / "sheet.png"]
        command = ["synth", "--out", out, "--scenes", 2, "--frames", 3, "--size", 16, *more, "--json"]
        # Older files, without the index that marks the folder as complete.
        return Operation(bench, name, command, once=True).age(drop=["000000.torch", "index.json"])

    def converted(name):
        shutil.copy(splat, out / "room.ply")
        command = ["convert", out / "room.ply", out / "room.ply", "--sh-degree", 1]
        return Operation(bench, name, command).take()

    def over_local_origin(name):
        """Overwrites a splat that has a local origin with one that has none."""
        bench.make(*convert)
        return Operation(bench, name, ["convert", splat, out / "far.spz", "--json"]).take()

    def aged(command, keep=(), **more):
        return lambda name: Operation(bench, name, command, **more).age(keep)

    scored = ["evaluation.json", "scenes/room_000.json", "scenes/room_000.jpg"]
    made = {
        "train": partial(training, stopped=False),
        "train, resumed": partial(training, stopped=True),
        "export": aged(export),
        "reconstruct": aged(reconstruct),
        "reconstruct --local-origin": aged([*reconstruct, "--local-origin"]),
        "refine --local-origin": aged(refine),
        "convert, in place": converted,
        "convert --local-origin": aged(convert),
        "convert, over a local origin": over_local_origin,
        "render, a folder": aged([*orbit, out / "views", "--depth"]),
        "render, .gif": aged([*orbit, out / "orbit.gif"]),
        "render, .mp4": aged([*orbit, out / "orbit.mp4"]),
        "eval --scene": aged(score),
        "eval > file": aged(score, into=out / "stdout"),
        "eval --data": aged([*sweep, out], keep=scored),
        "report": aged(report),
        "pack": packed,
        "synth": filmed,
    }
    for name, make in made.items():
        if not only or name in only:
            shutil.rmtree(out)
            out.mkdir()
            op = make(name)
            op.undisturbed()
            yield op


# The checks.


def check(op, fault):
    """Injects one fault. Returns the run and the errors, or None if no call was hit."""
    group, _, kind, sticky = fault
    op.reset()
    waits_forever = op.waits and sticky and kind in ("ENOSPC", "torn")
    done = op.bench.run(op.arguments, fault, stop_when_waiting=waits_forever, into=op.into)
    if not done.hit:
        return done, None
    tree, wrong = Tree(op.bench.out), []
    if done.code is None:
        wrong.append(f"it hasn't ended after {TIMEOUT} s")
    elif done.code not in (0, 1, 2) or "panicked" in done.errors or "internal error" in done.errors:
        wrong.append(f"it ended with {done.code}, by a signal or a panic")
    elif done.code == 0:
        wrong += tree.differs(op.new)
        if done.sentence:
            wrong.append("it reports an error, and succeeds")
        if done.output != op.output:
            wrong.append("its output differs")
    else:
        if not re.fullmatch(r"globalsplat: [^\n]+", done.sentence):
            wrong.append("it doesn't say why in one sentence")
        elif not op.names(done):
            wrong.append(f"it doesn't name {plain(done.hit[0])}")
        if done.output:
            wrong.append("it prints a result, and fails")
        if kind == "short" or (kind == "EINTR" and group in INTERRUPTIBLE):
            wrong.append("it doesn't go on")
        # The program waits for space on a full disk, but not when it checks that the folder is writable and not locked.
        is_probe = re.search(r"/out(/\.globalsplat-probe\.globalsplat-partial|/\.lock)?$", done.hit[0])
        if op.waits and not sticky and kind in ("ENOSPC", "torn") and not is_probe:
            wrong.append("it doesn't wait for space")
        # If renames fail persistently (all, or those onto this file), a rename can't be undone; the next run repairs
        # it.
        crashed = sticky and group in ("rename", "any")
        wrong += tree.mixes(op.trees, op.unit_of, crashed)
    return done, wrong


def describe(op, fault, done, wrong):
    """Describes a failure, with the options that reproduce it."""
    errors = done.errors.strip().replace("\n", "\n    ") or "no message"
    how = " ".join(map(str, fault))
    head = f'\n--only "{op.name}" --fault {how}, {done.hit[0]}\n  exit code {done.code}: {errors}'
    return "\n  ".join([head, *wrong])


def inject(operations, short, one):
    """Injects all faults and prints the table. Returns descriptions of the failures."""
    print("| operation | calls | faults injected | failures |\n|---|---|---|---|")
    failures = []
    for op in operations:
        faults = op.faults()
        if one:
            faults = [(one[0], int(one[1]), one[2], int(one[3]))]
        elif short:
            faults = random.Random(0).sample(faults, SHORT_OF_RUNS if op.waits else SHORT_OF_OTHERS)
        injected, earlier = 0, len(failures)
        for fault in faults:
            done, wrong = check(op, fault)
            if wrong is None:
                continue
            injected += 1
            # Chunks are never overwritten: the command fails on a folder that is complete.
            wrong += [] if op.once and done.code == 0 else op.again()
            if wrong:
                failures.append(describe(op, fault, done, wrong))
                print(failures[-1], file=sys.stderr, flush=True)
        calls = Counter(group for _, group, _ in op.calls)
        counts = ", ".join(f"{group} {calls[group]}" for group in FAULTS if calls[group])
        print(f"| {op.name} | {counts} | {injected} | {len(failures) - earlier} |", flush=True)
    return failures


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="run a fixed sample, in about a minute")
    parser.add_argument("--only", nargs="+", metavar="OPERATION")
    one = ("CALL", "N", "KIND", "STICKY")
    parser.add_argument("--fault", nargs=4, metavar=one, help="inject only this fault, as printed with a failure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        failures = inject(operations(Bench(Path(folder).resolve()), arguments.only), arguments.short, arguments.fault)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
