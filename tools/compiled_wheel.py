#!/usr/bin/env python3
"""Compile all inner loops and put them into a wheel, `swarm-loc-compiled`: `make compiled`.

The wheel serves machines with the same version of Python and of numba, and a CPU with x86-64-v3 (or arm64
with v8.2). Code is found by what it is compiled from: a wheel of another commit does no harm, what it lacks
is compiled as without it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from configparser import ConfigParser
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

from workspace.layout import ROOT

_SETUP = """
[metadata]
name = swarm-loc-compiled
version = {version}
description = Compiled inner loops of swarm_loc_estimator and swarm_loc_vision, for one version of Python.
license = Apache-2.0
[options]
packages = swarm_loc_compiled
zip_safe = false
install_requires = numba=={numba}
[options.package_data]
swarm_loc_compiled = *
[bdist_wheel]
python_tag = cp{python}
plat_name = {platform}
"""


def main() -> None:
    """Compile, pack, and print the path of the wheel."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "wheels", help="folder for the wheel")
    out = parser.parse_args().out.resolve()
    with TemporaryDirectory() as name:
        folder = Path(name)
        # where compiled code goes is read when it is compiled, in new processes
        os.environ["NUMBA_CACHE_DIR"] = str(folder / "cache")
        sys.path.append(str(ROOT))
        import numba  # noqa: PLC0415

        from conftest import PRECOMPILED  # noqa: PLC0415

        print("compiling all inner loops: about two minutes", flush=True)
        with ProcessPoolExecutor(2, get_context("spawn")) as processes:
            for done in [processes.submit(one) for one in PRECOMPILED]:
                done.result()
        package = folder / "wheel" / "swarm_loc_compiled"
        shutil.copytree(folder / "cache" / "swarm_loc_estimator", package)
        contents = hashlib.sha256("".join(sorted(file.name for file in package.iterdir())).encode())
        (package / "__init__.py").write_text('"""Compiled code, found by swarm_loc_estimator."""\n')
        released = ConfigParser()
        released.read(ROOT / "swarm_loc_estimator" / "setup.cfg")
        setup = _SETUP.format(
            version=f"{released['metadata']['version']}+{contents.hexdigest()[:12]}",
            numba=numba.__version__,
            python=f"{sys.version_info[0]}{sys.version_info[1]}",
            platform=sysconfig.get_platform().replace("-", "_").replace(".", "_"),
        )
        (package.parent / "setup.cfg").write_text(setup)
        (package.parent / "setup.py").write_text("import setuptools\n\nsetuptools.setup()\n")
        subprocess.run(
            [sys.executable, "setup.py", "--quiet", "bdist_wheel", "--dist-dir", out],
            cwd=package.parent,
            check=True,
        )
    wheel = max(out.glob("swarm_loc_compiled-*.whl"), key=lambda one: one.stat().st_mtime)
    print(f"Written: {wheel} ({wheel.stat().st_size / 1e6:.0f} MB)")


if __name__ == "__main__":
    main()
