"""Lists the licenses of everything that is distributed with the program, and fails on one that isn't allowed.

    python scripts/licenses.py                    checks, and prints the number of packages by license
    python scripts/licenses.py --out FILE         also writes all license texts
    python scripts/licenses.py --out FILE --cuda  the same, with NVIDIA's libraries for GPUs

The packages are the crates that the program links, the npm packages that web/ bundles, and the wheels that libtorch's libraries come from.
Needs only Python, cargo, and for --out the packages themselves.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from collections import Counter
from importlib.metadata import distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Licenses that ask for no more than their own text beside the program.
ALLOWED = {
    *("0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "IJG", "ISC", "MIT", "Unicode-3.0"),
    *("Unlicense", "Zlib"),
}
# NVIDIA's licenses let libraries be redistributed as parts of a program.
CPU_WHEELS = ["torch", "nvidia-cuda-cupti", "nvidia-cuda-runtime"]
LIBGOMP = (
    "GPL-3.0-or-later WITH GCC-exception-3.1",
    "libgomp.so.1, which comes with libtorch, and the parts of libstdc++ in the program are GCC's runtime libraries:\n"
    "GPL version 3 or later with the GCC Runtime Library Exception 3.1, by which programs under any license may contain\n"
    "and be distributed with them. Source: https://gcc.gnu.org. License: https://www.gnu.org/licenses/gpl-3.0.txt and https://www.gnu.org/licenses/gcc-exception-3.1.txt\n",
)
# Name, license expression and license texts of a package.
Package = tuple[str, str, list[str]]
TEXT = re.compile(r"(un)?licen[sc]e|copying|notice|copyright", re.IGNORECASE)


def is_allowed(expression: str) -> bool:
    """Returns whether an SPDX expression can be met with allowed licenses alone."""
    expression = re.sub(r" WITH \S+?(?=[\s)]|$)", "", expression.replace("/", " OR "))
    words = re.findall(r"[()]|[^\s()]+", expression)
    python = [w if w in "()" else w.lower() if w in ("AND", "OR") else str(w in ALLOWED) for w in words]
    return bool(words) and bool(eval(" ".join(python), {}))  # Only True, False, and, or and parentheses.


def texts(folder: Path, depth: int = 1) -> list[str]:
    """Returns the license texts in a folder of a package, and in `depth` levels of folders below it."""
    found = []
    for path in sorted(folder.iterdir()):
        if path.is_file() and TEXT.match(path.name):
            found.append(path.read_text(errors="replace").strip() + "\n")
        elif path.is_dir() and depth > 0:
            found += texts(path, depth - 1)
    return found


def crates() -> list[Package]:
    """Returns every crate that the program links."""

    def cargo(*command: str) -> str:
        command = (os.environ.get("CARGO", "cargo"), *command, "--locked")
        return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True, text=True).stdout

    tree = cargo("tree", "--package", "globalsplat", "--edges", "normal", "--prefix", "none", "--format", "{p}")
    linked = {tuple(line.split()[:2]) for line in tree.splitlines()}
    found = []
    for package in json.loads(cargo("metadata", "--format-version", "1"))["packages"]:
        if package["source"] and (package["name"], f"v{package['version']}") in linked:
            # A package without a text has a license whose text is the same for everyone, or asks for the authors' names.
            authors = ", ".join(package["authors"]) or package["repository"]
            written = texts(Path(package["manifest_path"]).parent)
            written = written or [f"By {authors}. The text is that of {package['license']}.\n"]
            found.append((f"{package['name']} {package['version']}", package["license"] or "", written))
    return sorted(found)


def npm_packages(with_texts: bool) -> list[Package]:
    """Returns every npm package that web/ bundles: all but those for development."""
    found = []
    for folder, package in json.loads((ROOT / "web/package-lock.json").read_text())["packages"].items():
        if folder and not package.get("dev"):
            written = texts(ROOT / "web" / folder, 0) if with_texts else []
            name = folder.removeprefix("node_modules/")
            found.append((f"{name} {package['version']}", package.get("license", ""), written))
    return found


def wheels(cuda: bool) -> list[Package]:
    """Returns the wheels that libtorch and the libraries that it loads come from."""
    libtorch = Path(os.environ.get("LIBTORCH") or ROOT / ".venv/libtorch").resolve()
    found = []
    for wheel in distributions(path=[str(libtorch.parent)]):
        name = wheel.metadata["Name"].lower()
        if name in CPU_WHEELS or (cuda and name.startswith("nvidia-")):
            license = wheel.metadata["License-Expression"] or wheel.metadata["License"] or ""
            files = [file for file in wheel.files or [] if TEXT.match(file.name) and file.suffix in ("", ".txt")]
            written = [Path(str(file.locate())).read_text(errors="replace").strip() + "\n" for file in files]
            found.append((f"{name} {wheel.version}", license, written))
    return sorted(found)


def main() -> None:
    """Checks the licenses, and writes their texts if a file is named."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, help="the file to write all license texts to")
    parser.add_argument("--cuda", action="store_true", help="include NVIDIA's libraries for GPUs")
    options = parser.parse_args()
    ours = crates() + npm_packages(options.out is not None)
    refused = [f"{name} has the license {license!r}" for name, license, _ in ours if not is_allowed(license)]
    if options.out:
        ours += [*wheels(options.cuda), ("libgomp, libstdc++", LIBGOMP[0], [LIBGOMP[1]])]
        refused += [f"{name} comes without a license text" for name, _, written in ours if not written]
    if refused:
        sys.exit("\n".join(f"licenses: {line}, see scripts/licenses.py" for line in refused))
    if options.out:
        users: dict[str, list[str]] = {}
        for name, license, written in ours:
            for text in written:
                users.setdefault(text, []).append(f"{name} ({license})")
        with options.out.open("w", encoding="utf-8") as file:
            for text, names in users.items():
                file.write(f"{'=' * 100}\n{', '.join(dict.fromkeys(names))}\n{'=' * 100}\n\n{text}\n")
    counts = Counter(license for _, license, _ in ours)
    print(f"licenses: {len(ours)} packages: " + ", ".join(f"{n} {license}" for license, n in counts.most_common()))


if __name__ == "__main__":
    main()
