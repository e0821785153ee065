"""What `bash .ci/packages` checks, each by a word: pins, imports, contents, clip, audit.

The wheel's modules are judged by the checkout's, so nothing here is imported from the checkout.
"""

import importlib
import json
import pkgutil
import re
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

#: What an environment starts with, of no project's choosing.
ITS_OWN = {"pip", "setuptools", "foldgauss"}
#: In a checkout, but of no use without its history.
LEFT_OUT = {".gitignore"}
#: Of a package, and not of the checkout.
ADDED = {"PKG-INFO", ".gitignore"}


def name_of(requirement: str) -> str:
    """The name of `name==version`, as the index normalises it."""
    return re.sub(r"[-_.]+", "-", requirement.partition("==")[0]).lower()


def pins(constraints: str, python: str) -> None:
    """Every distribution installed beside `python` has a line in `constraints`."""
    lines = Path(constraints).read_text().splitlines()
    pinned = {name_of(line) for line in lines if line and not line.startswith("#")}
    words = [python, "-m", "pip", "list", "--format", "freeze"]
    listed = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    unpinned = {name_of(line) for line in listed.splitlines()} - pinned - ITS_OWN
    if unpinned:
        raise SystemExit(f"{constraints}: expected every distribution that is installed, lacks {sorted(unpinned)}")
    print(f"pinned: all {len(listed.splitlines())} distributions")


def imports(checkout: str) -> None:
    """Every module that needs no extra, and not from the checkout; the switch `-W error` is the caller's."""
    import foldgauss

    if Path(foldgauss.__file__).is_relative_to(checkout):
        raise SystemExit(f"foldgauss: expected the installed one, got that of the checkout, {foldgauss.__file__}")
    done, left = 0, []
    for module in pkgutil.walk_packages(foldgauss.__path__, "foldgauss."):
        if module.name == "foldgauss.__main__":
            continue
        try:
            importlib.import_module(module.name)
            done += 1
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in ("sklearn", "emcee"):  # of extras
                raise
            left.append(module.name)
    for name in foldgauss.__all__:
        getattr(foldgauss, name)
    print(f"imported: {done} modules; of extras that are not installed: {', '.join(left) or 'none'}")


def contents(checkout: str, *packages: str) -> None:
    """The wheel holds all of foldgauss/ and nothing else, the sdist all that git knows, or would after `git add`."""
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    told = subprocess.run(words, cwd=checkout, capture_output=True, text=True)
    if told.returncode:
        print(f"contents NOT COMPARED: {checkout} is no checkout of git")
        return
    known = {name for name in told.stdout.splitlines() if (Path(checkout) / name).exists()} - LEFT_OUT
    for package in packages:
        if package.endswith(".whl"):
            with zipfile.ZipFile(package) as archive:
                names = {name for name in archive.namelist() if ".dist-info/" not in name}
            _same(package, names, {name for name in known if name.startswith("foldgauss/")})
        else:
            with tarfile.open(package) as archive:
                names = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
            _same(package, names - ADDED, known)


def _same(package: str, names: set[str], expected: set[str]) -> None:
    if names != expected:
        lacking, stray = sorted(expected - names), sorted(names - expected)
        raise SystemExit(f"{Path(package).name}: expected what git knows; lacks {lacking}, has besides {stray}")
    print(f"{Path(package).name}: {len(names)} files, as in the checkout")


def clip(path: str) -> None:
    """A clip of eight small frames, to be fitted."""
    import numpy as np

    from foldgauss.io import write_video

    row = np.linspace(0, 255, 64, dtype=np.uint8)
    frames = [np.broadcast_to(np.roll(row, 4 * k)[None, :, None], (48, 64, 3)).copy() for k in range(8)]
    write_video(path, frames, 8.0)


def audit(constraints: str, pip_audit: str) -> None:
    """Fails for a known vulnerability of a pinned version; says so where nothing could be looked up."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "audit.json"
        arguments = ["--requirement", constraints, "--no-deps", "--disable-pip", "--progress-spinner", "off"]
        words = [pip_audit, *arguments, "--format", "json", "--output", str(report)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=600)
        if not report.exists():
            print(f"NOT AUDITED: the service could not be reached: {done.stderr.strip().splitlines()[-1:]}")
            return
        found = json.loads(report.read_text())["dependencies"]
    audited = [one for one in found if "skip_reason" not in one]
    if not audited:
        print(f"NOT AUDITED: the service knows none of {len(found)} distributions, so it is not the public one")
        return
    vulnerable = [
        f"{one['name']} {one['version']}: {[it['id'] for it in one['vulns']]}" for one in audited if one["vulns"]
    ]
    if vulnerable:
        raise SystemExit("known vulnerabilities:\n" + "\n".join(vulnerable))
    print(f"audited: {len(audited)} of {len(found)} distributions, no known vulnerability")


if __name__ == "__main__":
    {"pins": pins, "imports": imports, "contents": contents, "clip": clip, "audit": audit}[sys.argv[1]](*sys.argv[2:])
