"""Builds the CUDA library, where there is something to build it with and for. Everything else is in pyproject.toml.

Environment:
    TURBOGS_CUDA: ``auto`` (default) builds where nvcc, torch's headers and a GPU are found, and else, or where nvcc
        fails, ends CPU-only, saying why in one line; ``require`` makes a missing library an error; ``off`` builds
        nothing.
    TURBOGS_CUDA_ARCH: compute capabilities to build for, such as ``90`` or ``80;90``, in place of the GPUs found here;
        8.0 or newer. ``compute_80`` is PTX of 8.0, which the driver compiles when it loads the library: on any GPU from
        8.0, at the price of a slow first call. Several capabilities bring PTX of the newest, unless PTX is named.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
SOURCES = ROOT / "csrc"
BUILD_COMMANDS = {"build", "build_ext", "bdist_wheel", "editable_wheel", "develop", "install"}
OLDEST_CAPABILITY = 80  # warp reductions in hardware (__reduce_*_sync)
PTX = "compute_"
FIRST_TORCH = (2, 10)
TORCH_TARGET = "0x020A000000000000ULL"  # the same: the library loads on torch 2.10 and later


class CannotBuildError(Exception):
    """Why there will be no CUDA library, in one line."""


@dataclass
class Toolchain:
    nvcc: Path
    torch: Path
    architectures: list[str]

    @property
    def code_flags(self) -> list[str]:
        """Machine code for every architecture; of several also PTX of the newest, for GPUs that come after it."""
        return [f"-gencode=arch=compute_{name.split('_')[1]},code={name}" for name in self.code_names]

    @property
    def code_names(self) -> list[str]:
        """What the library holds: ``sm_90`` is machine code, ``compute_90`` PTX. A library for one GPU has no PTX."""
        names = [a if a.startswith(PTX) else f"sm_{a}" for a in self.architectures]
        has_ptx = any(name.startswith(PTX) for name in names)
        return names if has_ptx or len(names) == 1 else [*names, f"{PTX}{self.architectures[-1]}"]


def find_nvcc() -> Path:
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        if os.environ.get(variable) and (path := Path(os.environ[variable], "bin", "nvcc")).is_file():
            return path
    for candidate in (shutil.which("nvcc"), "/usr/local/cuda/bin/nvcc"):
        if candidate and Path(candidate).is_file():
            return Path(candidate)
    raise CannotBuildError("no nvcc (set CUDA_HOME to a CUDA toolkit)")


def find_torch() -> Path:
    """The folder of the torch package. Build isolation hides it from imports, but not from the file system."""
    spec = find_spec("torch")
    candidates = [Path(spec.origin).parent] if spec and spec.origin else []
    candidates += [Path(sysconfig.get_path(key), "torch") for key in ("purelib", "platlib")]
    for path in candidates:
        if (path / "version.py").is_file() and (path / "include/torch").is_dir():
            version = re.search(r"__version__ = '((\d+)\.(\d+)[^']*)'", (path / "version.py").read_text())
            if version and (int(version[2]), int(version[3])) < FIRST_TORCH:
                oldest = ".".join(map(str, FIRST_TORCH))
                raise CannotBuildError(f"it needs torch {oldest} or later, this is {version[1]}")
            return path
    raise CannotBuildError("torch's headers are not in the build environment (install with --no-build-isolation)")


def capability(architecture: str) -> int:
    """90 of ``90``, ``90a``, ``90f``, ``compute_90``."""
    return int(architecture.removeprefix(PTX).rstrip("af"))


def find_architectures() -> list[str]:
    named = os.environ.get("TURBOGS_CUDA_ARCH", "")
    if named:
        found = [part.replace(".", "") for part in re.split(r"[;,\s]+", named) if part]
        if not found or not all(re.fullmatch(rf"({PTX})?\d{{2,3}}[af]?", part) for part in found):
            raise SystemExit(
                f"TURBOGS_CUDA_ARCH={named!r}: expected compute capabilities such as 90, 80;90 or compute_80"
            )
        if any(capability(part) < OLDEST_CAPABILITY for part in found):
            raise SystemExit(f"TURBOGS_CUDA_ARCH={named!r}: the CUDA library needs compute capability 8.0 or newer")
    else:
        query = ["nvidia-smi", "--query-gpu=compute_cap", "--format=csv,noheader"]
        try:
            lines = subprocess.run(query, capture_output=True, text=True, check=True).stdout.split()
        except (OSError, subprocess.CalledProcessError):
            lines = []
        found = [line.replace(".", "") for line in lines if re.fullmatch(r"\d+\.\d", line)]
        if not found:
            raise CannotBuildError("nvcc is here but no GPU, and TURBOGS_CUDA_ARCH names none")
        newest = max(found, key=capability)
        found = [part for part in found if capability(part) >= OLDEST_CAPABILITY]
        if not found:
            raise CannotBuildError(f"it needs compute capability 8.0 or newer, the GPU has {newest[:-1]}.{newest[-1]}")
    return sorted(set(found), key=lambda part: (capability(part), part))


def run_compiler(command: list[str], what: str) -> None:
    """Run nvcc, and pass its messages on.

    Raises:
        CannotBuildError: it failed; the line holds its first error.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    except OSError as error:
        raise CannotBuildError(f"{command[0]} does not run: {error.strerror}") from None
    messages = (done.stderr + done.stdout).strip()
    if messages:
        print(messages, file=sys.stderr, flush=True)
    if done.returncode:
        lines = [line.strip() for line in messages.splitlines()] or [f"exit status {done.returncode}"]
        first = next((line for line in lines if re.search(r"\b(error|fatal)\b", line)), lines[-1])
        raise CannotBuildError(f"nvcc failed {what}: {first}")


def give_up(mode: str, reason: CannotBuildError) -> None:
    """End with an error where the library is required, else say that there will be none."""
    if mode == "require":
        raise SystemExit(f"turbogs: TURBOGS_CUDA=require, but no CUDA library: {reason}")
    print(f"turbogs: CPU only, no CUDA library: {reason}", flush=True)


def plan() -> tuple[str, Toolchain | None]:
    """The mode asked for, and what to build with (None: nothing is built)."""
    mode = os.environ.get("TURBOGS_CUDA", "auto")
    if mode not in ("auto", "require", "off"):
        raise SystemExit(f"TURBOGS_CUDA={mode!r}: expected auto, require or off")
    building = bool(BUILD_COMMANDS.intersection(sys.argv))
    if mode == "off" or not building:
        return mode, None
    try:
        return mode, Toolchain(find_nvcc(), find_torch(), find_architectures())
    except CannotBuildError as reason:
        give_up(mode, reason)
        return mode, None


class BuildCuda(build_ext):
    """Compiles every .cu and .cpp below csrc/ with nvcc and links them into one library."""

    def build_extension(self, extension: Extension) -> None:
        library = Path(self.get_ext_fullpath(extension.name))
        try:
            self.build_library(library)
        except CannotBuildError as reason:
            library.unlink(missing_ok=True)  # one of a build before this one
            give_up(mode, reason)

    def build_library(self, library: Path) -> None:
        objects_dir = Path(self.build_temp, "csrc").resolve()
        generated = objects_dir / "generated"
        sys.path.insert(0, str(SOURCES))
        import generate_headers

        generate_headers.write(generated)
        headers = [*SOURCES.rglob("*.h"), *SOURCES.rglob("*.cuh"), *generated.iterdir(), Path(__file__)]
        newest_header = max(path.stat().st_mtime for path in headers)
        sources = sorted(SOURCES.rglob("*.cu"), key=lambda path: -path.stat().st_size) + sorted(SOURCES.rglob("*.cpp"))

        def compile_one(source: Path) -> Path:
            target = objects_dir / source.relative_to(SOURCES).with_name(source.name + ".o")
            target.parent.mkdir(parents=True, exist_ok=True)
            command = self.cuda_command() if source.suffix == ".cu" else self.cpp_command()
            command += [f"-I{SOURCES}", f"-I{generated}", "-c", str(source)]
            stamp = target.with_suffix(".command")
            text = " ".join(command)
            fresh = target.exists() and target.stat().st_mtime > max(newest_header, source.stat().st_mtime)
            if not (fresh and stamp.exists() and stamp.read_text() == text):
                run_compiler([*command, "-o", str(target)], f"on {source.name}")
                stamp.write_text(text)
            return target

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            objects = list(pool.map(compile_one, sources))
        library.parent.mkdir(parents=True, exist_ok=True)
        link = [str(toolchain.nvcc), *toolchain.code_flags, "-shared", f"-L{toolchain.torch / 'lib'}"]
        link += ["-Xlinker", "--no-as-needed,-ltorch", "-o", str(library), *map(str, objects)]
        run_compiler(link, "to link")
        print(f"turbogs: built {library.name} with {toolchain.nvcc} {' '.join(toolchain.code_flags)}", flush=True)

    def cuda_command(self) -> list[str]:
        flags = ["-O3", "-std=c++17", "-lineinfo", "-Xcompiler", "-fPIC,-fvisibility=hidden"]
        return [str(toolchain.nvcc), *toolchain.code_flags, *flags]

    def cpp_command(self) -> list[str]:
        # nvcc hands .cpp files to the host compiler, and knows where the toolkit's headers are.
        flags = ["-O2", "-std=c++17", "-Xcompiler", "-fPIC,-fvisibility=hidden", f"-I{toolchain.torch / 'include'}"]
        names = " ".join(toolchain.code_names)
        flags += ["-DUSE_CUDA", f"-DTORCH_TARGET_VERSION={TORCH_TARGET}", f'-DTURBOGS_ARCHITECTURES="{names}"']
        return [str(toolchain.nvcc), *flags]


mode, toolchain = plan()
library = Extension("turbogs_plugin._C", sources=[], py_limited_api=True, optional=mode == "auto")
setup(
    ext_modules=[library] if toolchain else [],
    cmdclass={"build_ext": BuildCuda},
    options={"bdist_wheel": {"py_limited_api": "cp310"}} if toolchain else {},
)
