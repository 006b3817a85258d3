#!/usr/bin/env python3
"""Injects faults into the writing system calls of commands that write files, and checks the files afterwards.

    .venv/bin/python scripts/faults/run.py [--short] [--only OPERATION ...] [--fault GROUP N KIND STICKY]

There is one operation for each way in which the program writes. It runs without faults first, under inject.c, which
records its calls. Then, for every call and every kind of fault, it runs again from the same state. Afterwards
  - it must have ended by itself, without a signal or a panic: with all files new, or one sentence that names the file;
  - every file, and every checkpoint as a whole, must be the old one or the new one;
  - if it failed before all files were new, the same command without faults must succeed, with the files of the first run
    and no others but those that couldn't be removed.
Prints a Markdown table, and every failure with the options that reproduce it.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path

from tensorboard.compat.tensorflow_stub.errors import DataLossError, OutOfRangeError
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import PyRecordReader_New

REPOSITORY = Path(__file__).resolve().parents[2]
# (kind, sticky) of the faults of each group of calls, as in inject.c.
ERRORS = [("ENOSPC", 0), ("ENOSPC", 1), ("EIO", 0), ("EIO", 1), ("EINTR", 0)]
FAULTS = {
    "write": [*ERRORS, ("short", 0), ("short", 1), ("torn", 0), ("torn", 1)],
    **dict.fromkeys(["truncate", "fsync", "open", "mkdir", "rename", "link"], ERRORS),
    "remove": [("EIO", 0), ("EIO", 1)],
    "any": [("EIO", 1)],  # a lost disk, which leaves the same state as a crash
}
# Calls that must be repeated after EINTR. Linux doesn't interrupt the others on a local disk.
INTERRUPTIBLE = {"write", "truncate", "fsync", "open"}
# Number of faults with --short: of training, and of any other operation.
SHORT_OF_TRAINING, SHORT_OF_OTHERS = 8, 3
# Time after which a command is killed, in seconds.
TIMEOUT = 60


def final_name(path):
    """Replaces names of temporary files with the names that errors use."""
    path = re.sub(r"/\.([^/ ]+?)\.globalsplat-partial(-\d+)?(?=[/ :]|$)", r"/\1", str(path))
    return "standard output" if path.endswith("/out/stdout") else path.replace("/globalsplat-probe", "")


def read_log(path):
    """Returns the records of a metrics.jsonl without times; of an event file, that it is whole."""
    if path.suffix == ".jsonl":
        lines = re.findall("[^\n]*\n|[^\n]+$", path.read_text())
        return [re.sub('"samples_per_second":[^,}]*', "", line) for line in lines]
    reader = PyRecordReader_New(str(path))
    try:
        while True:
            reader.GetNext()
    except OutOfRangeError:
        return ["whole"]
    except DataLossError:
        return ["broken"]


def read_files(folder, has_scores=True):
    """Returns what is below a folder by name, and the names of temporary files.

    The value of a file is its hash, that of a complete checkpoint the hashes of its files, and that of logs their records.
    Without scores, the state of a checkpoint is that before it is known to be the best.
    """
    files, temporary = {}, []
    for path in sorted(folder.rglob("*")):
        name, parent = (part.relative_to(folder).as_posix() for part in (path, path.parent))
        if ".globalsplat-" in name:
            temporary.append(name)
        elif name == "metrics.jsonl" or parent == "tensorboard":
            files[name] = read_log(path)
        elif path.is_symlink():
            files[name] = str(path.readlink())
        elif path.is_file() and name not in (".lock", "stdout"):
            content = path.read_bytes()
            if path.name == "state.json" and not has_scores:
                content = json.dumps(json.loads(content) | {"validation": None}).encode()
            digest = hashlib.sha1(content).hexdigest()
            if not parent.startswith("checkpoints/"):
                files[name] = digest
            elif path.with_name("state.json").exists():
                files.setdefault(parent, {})[path.name] = digest
    return files, temporary


class Bench:
    """The working folder: in/ is only read, and faults are injected in out/, where standard output goes, too."""

    def __init__(self, folder):
        self.inputs, self.out, self.old = folder / "in", folder / "out", folder / "old"
        self.library, self.log = folder / "inject.so", folder / "calls"
        flags = ["-Wall", "-Wextra", "-O1", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, "-o", self.library, Path(__file__).with_name("inject.c"), "-ldl"], check=True)
        for path in (self.inputs, self.out, folder / "bin"):
            path.mkdir()
        # A fake encoder is enough to test how the program writes videos. Without LPIPS weights, scoring is fast.
        encodes = 'case $* in *-encoders*) echo libx264; exit;; esac\nfor out; do :; done\nexec cat > "$out"\n'
        (folder / "bin/ffmpeg").write_text(f"#!/bin/sh\n{encodes}")
        (folder / "bin/ffmpeg").chmod(0o755)
        self.environment = os.environ | {"OMP_NUM_THREADS": "1", "GLOBALSPLAT_WEIGHTS": str(folder / "none")}
        self.environment |= {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "LD_PRELOAD": str(self.library)}
        self.environment |= {"FAULT_ROOT": str(self.out), "FAULT_LOG": str(self.log)}

    def run(self, command, fault=()):
        """Runs the program with a fault, (group, n, kind, sticky). Returns its exit code, standard error, and its calls:
        whether they failed, their groups and files."""
        self.log.write_text("")
        environment = self.environment | {"FAULT": " ".join(map(str, fault))}
        program = list(map(str, [REPOSITORY / "target/release/globalsplat", *command]))
        with (self.out / "stdout").open("wb") as out:
            process = subprocess.Popen(program, stdout=out, stderr=subprocess.PIPE, text=True, env=environment)
        timer = threading.Timer(TIMEOUT, process.kill)
        timer.start()
        errors = process.communicate()[1]
        timer.cancel()
        calls = [line.split(" ", 2) for line in self.log.read_text().splitlines()]
        return process.returncode, errors, [(outcome == "!", group, Path(file)) for outcome, group, file in calls]

    def succeed(self, command):
        """Runs the program, which must succeed. Returns its calls."""
        code, errors, calls = self.run(command)
        assert code == 0, errors
        return calls


class Operation:
    """A command that starts from the files that are in out/ now, and its run without faults."""

    def __init__(self, bench, name, command, between):
        self.bench, self.name, self.command = bench, name, command
        shutil.rmtree(bench.old, ignore_errors=True)
        shutil.copytree(bench.out, bench.old, symlinks=True)
        old, _ = read_files(bench.out, has_scores=False)
        self.groups = Counter(group for _, group, _ in bench.succeed(command))
        self.new, temporary = read_files(bench.out)
        assert not temporary and self.new != old, name
        # What may be left: the old files, those between, and the new ones.
        self.states = [old, *between, read_files(bench.out, has_scores=False)[0]]

    def faults(self):
        """Returns (group, n, kind, sticky) for every kind of fault of every call."""
        count = self.groups | Counter(any=self.groups.total())
        return [(group, n, *fault) for group in FAULTS for n in range(1, count[group] + 1) for fault in FAULTS[group]]

    def differences(self, not_removed=()):
        """Returns what differs in out/ from what the run without faults leaves. Files that couldn't be removed may stay."""
        found, temporary = read_files(self.bench.out)
        # A resumed run has another event file.
        names = [name for name in found if found[name] != ["whole"] and found[name] != self.new.get(name)]
        names += self.new.keys() - found.keys()
        left = [name for name in temporary if self.bench.out / name not in not_removed]
        return [f"{name} isn't the new one" for name in names] + [f"{name} is left" for name in left]

    def mixtures(self):
        """Returns which files in out/ are neither old nor new."""
        (found, _), old = read_files(self.bench.out, has_scores=False), self.states[0]
        wrong = []
        for name, value in found.items():
            is_log = isinstance(value, list)
            is_begun_log = is_log and value in (["whole"], self.new.get(name, [])[: len(value)])
            if not is_begun_log and value not in [state.get(name) for state in self.states]:
                wrong.append(f"{name} is neither old nor new")
        wrong += [f"{name} is gone" for name in old.keys() & self.new.keys() - found.keys()]
        has_checkpoint = [any(name.startswith("checkpoints/") for name in state) for state in (old, found)]
        return wrong + ["all checkpoints are gone"] * (has_checkpoint == [True, False])

    def check(self, fault):
        """Injects one fault. Returns what is wrong, with a description of the run, or None if no call was hit."""
        group, _, kind, _ = fault
        shutil.rmtree(self.bench.out)
        shutil.copytree(self.bench.old, self.bench.out, symlinks=True)
        code, errors, calls = self.bench.run(self.command, fault)
        hit = [(call, file) for has_failed, call, file in calls if has_failed]
        if not hit:
            return None
        first = str(hit[0][1])
        messages = [line for line in errors.splitlines() if line.startswith("globalsplat: ")]
        output = (self.bench.out / "stdout").read_text()
        wrong = [f"it ended by a signal, or was killed after {TIMEOUT} s"] * (code not in (0, 1, 2))
        wrong += ["it panicked"] * ("panicked" in errors or "internal error" in errors)
        if code == 0:
            wrong += self.differences()
            wrong += ["it reports an error, and succeeds"] * bool(messages)
            wrong += ["its output isn't whole"] * (not output.endswith("}\n"))
        else:
            named = [file for _, file in hit]
            for call, file in hit:
                # A folder that is removed is named instead of its files.
                named += [folder for folder in file.parents if call == "remove" and self.bench.out in folder.parents]
            goes_on = kind == "short" or (kind == "EINTR" and group in INTERRUPTIBLE)
            message = final_name(messages[0]) if messages == errors.splitlines()[-1:] else ""
            wrong += ["it doesn't say why in one sentence at the end"] * (not message)
            wrong += [f"it doesn't name {final_name(first)}"] * (not any(final_name(path) in message for path in named))
            wrong += ["it prints a result, and fails"] * (output != "" and not first.endswith("/stdout"))
            wrong += ["it doesn't go on"] * goes_on
            wrong += self.mixtures()
            not_removed = [file for call, file in hit if call == "remove"]
            if self.differences(not_removed):
                code_again, errors_again, _ = self.bench.run(self.command)
                wrong += [f"second run: {errors_again.strip()}"] * (code_again != 0)
                wrong += [f"second run: {difference}" for difference in self.differences(not_removed)]
        return wrong and [f"exit code {code}: {errors.strip() or 'no message'} ({first})", *wrong]


def operations(bench, only):
    """Yields the operations, on synthetic scenes and weights that the program creates, with the configuration of
    tests/common/program.rs."""
    inputs, out = bench.inputs, bench.out
    scenes, tiny, weights = inputs / "scenes", inputs / "tiny.toml", inputs / "tiny.safetensors"
    config = (REPOSITORY / "tests/common/program.rs").read_text().split('TINY_CONFIG: &str = r#"')[1].split('"#')[0]
    config = config.replace("[data]", f"[data]\ncaptures = [{json.dumps(str(scenes))}]")
    tiny.write_text(config + "validate_every = 2\n")
    splat, evaluation = inputs / "splats/0_000000.ply", inputs / "evaluation"
    reconstruct = ["reconstruct", "--weights", weights, "--scene", f"{scenes}/000000.torch#0_000000", "--out"]
    evaluate = ["eval", "--splat", splat.parent, "--data", scenes, "--index", scenes / "evaluation_index.json", "--out"]
    bench.succeed(["synth", "--out", scenes, "--scenes", 2, "--frames", 12, "--size", 32])
    bench.succeed(["export", "--config", tiny, "--out", weights])
    bench.succeed([*reconstruct, splat])
    shutil.copy(splat, splat.with_stem("0_000001"))
    bench.succeed([*evaluate, evaluation])
    splat.with_name("0_000000.ply.origin.json").write_text(json.dumps({"origin": [5e6, 4e5, 100.0]}))

    train = ["train", "--config", tiny, "--out", out]
    render = ["render", "--splat", splat, "--size", "24x24", "--orbit", "--frames", 3, "--out"]
    creating = {
        "train": train,
        "train, resumed": train,
        "eval": [*evaluate, out],
        "synth": [
            "synth",
            "--out",
            out,
            "--scenes",
            2,
            "--frames",
            3,
            "--size",
            16,
            "--depth",
            "--contact-sheet",
            out / "sheet.png",
        ],
    }
    replacing = {
        "reconstruct": [*reconstruct, out / "room.ply"],
        "convert --local-origin": ["convert", splat, out / "far.spz", "--local-origin"],
        "render, a folder": [*render, out / "views", "--depth"],
        "render, a film": [*render, out / "orbit.mp4"],
        "report": ["report", evaluation, "--out", out / "report.html"],
    }
    for name, command in (creating | replacing).items():
        if only and name not in only:
            continue
        shutil.rmtree(out)
        out.mkdir()
        between = []
        if command == train:
            # A run that couldn't write its checkpoint of step 6, and has those of steps 2 and 4.
            renamed = [file for _, group, file in bench.succeed(command) if group == "rename"]
            nth = renamed.index(out / "checkpoints/step-00000006/state.json") + 1
            shutil.rmtree(out)
            out.mkdir()
            assert bench.run(command, ("rename", nth, "EIO", 0))[0] == 1
            between.append(read_files(out, has_scores=False)[0])
        if name == "train":
            shutil.rmtree(out)
            out.mkdir()
        if name in replacing:
            bench.succeed(command)
            for path in [path for path in out.rglob("*") if path.is_file()]:
                path.write_bytes(b"old\n" + path.read_bytes())
        yield Operation(bench, name, [*command, "--json"], between)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="run a fixed sample, in about a minute")
    parser.add_argument("--only", nargs="+", metavar="OPERATION")
    one = ("GROUP", "N", "KIND", "STICKY")
    parser.add_argument("--fault", nargs=4, metavar=one, help="inject only this fault, as printed with a failure")
    arguments = parser.parse_args()
    failures = injected = 0
    print("| operation | calls | faults injected | failures |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        for op in operations(Bench(Path(folder).resolve()), arguments.only):
            faults = op.faults()
            if arguments.fault:
                group, n, kind, sticky = arguments.fault
                faults = [(group, int(n), kind, int(sticky))]
            elif arguments.short:
                faults = random.Random(0).sample(
                    faults, SHORT_OF_TRAINING if op.command[0] == "train" else SHORT_OF_OTHERS
                )
            results = [(fault, wrong) for fault in faults if (wrong := op.check(fault)) is not None]
            for fault, wrong in results:
                if wrong:
                    how = " ".join(map(str, fault))
                    print(f'\n--only "{op.name}" --fault {how}', *wrong, sep="\n  ", file=sys.stderr, flush=True)
            failed = sum(bool(wrong) for _, wrong in results)
            counts = ", ".join(f"{group} {op.groups[group]}" for group in FAULTS if op.groups[group])
            print(f"| {op.name} | {counts} | {len(results)} | {failed} |", flush=True)
            failures += failed
            injected += len(results)
    if injected == 0:
        parser.error("no operation of this name, or no call of this fault")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
