"""A minimal Debian as somebody has just installed it, with a user and a clone of this project."""

import os
import shutil
import subprocess
from pathlib import Path

from tower.roots import ALONE, SUITE, debian_sources

ROOT = Path(__file__).parents[2]
USER = "student"
HOME = f"/home/{USER}"
PATIENCE_S = 3000
BUILD_S = 900
INDEX_FILES = (
    "etc/pip.conf",
    "etc/xdg/pip",
    "etc/ssl/certs/ca-certificates.crt",
    "etc/resolv.conf",
    "etc/hosts",
)
"""By these a program in it finds the package index that programs here find."""
INDEX_VARIABLES = (
    "PIP_",
    "SSL_CERT_",
    "REQUESTS_CA_",
    "CURL_CA_",
    "UV_",
    "HTTP_PROXY",
    "HTTPS_PROXY",
)
ENTER = """
mount --rbind /dev dev && mount -t proc proc proc && mount -t sysfs sysfs sys
mount -t tmpfs tmpfs tmp && mount -t tmpfs -o mode=1777 shm dev/shm
chroot . "$@"
exit $?
"""
"""The shell stays, as the first process of a system does, and takes leave of those whose parents are gone."""


class FreshDebian:
    """
    A root file system made by mmdebstrap.

    Args:
        folder: Where it is made.
        packages: Installed beside Debian's own minimum.

    Raises:
        RuntimeError: It could not be built; the text is mmdebstrap's.
    """

    def __init__(self, folder, packages):
        self.root = folder / "root"
        command = [*ALONE, "mmdebstrap", "--variant=minbase", "--skip=check/empty"]
        command += [f"--include={','.join(packages)}", SUITE, str(self.root), *debian_sources()]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=BUILD_S)
        if done.returncode:
            raise RuntimeError(done.stderr[-3000:])
        for name in INDEX_FILES:
            self._bring(name)
        self.run_as_root(f"useradd --create-home --shell /bin/bash {USER}")
        clone = self.root / HOME.lstrip("/") / "cosmos"
        subprocess.run(["git", "clone", "-q", "--no-hardlinks", ROOT, clone], check=True)
        self.run_as_root(f"chown -R {USER}: {HOME}")

    def run_as_root(self, command):
        """Run a shell command as root in it; return what became of it."""
        return self._run("/bin/bash", "-c", command)

    def run(self, command):
        """Run a shell command as its user, in the clone; return what became of it."""
        return self._run("/bin/su", USER, "-c", f"cd {HOME}/cosmos && {command}")

    def _run(self, *command):
        variables = {k: v for k, v in os.environ.items() if k.upper().startswith(INDEX_VARIABLES)}
        return subprocess.run(
            ["unshare", "--mount", *ALONE[1:-1], "--", "/bin/sh", "-ec", ENTER, "sh", *command],
            cwd=self.root,
            env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8", **variables},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )

    def _bring(self, name):
        source, target = Path("/") / name, self.root / name
        if source.is_dir():
            shutil.copytree(source, target, symlinks=False, dirs_exist_ok=True)
        elif source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
