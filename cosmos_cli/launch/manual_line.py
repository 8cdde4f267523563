"""
The line to an agent that a person starts by hand, on a terminal or in a debugger.

A unix socket in a private folder stands in for the pipes of a started child: whoever connects gets the
launch line, which holds the run key, so only the same user may.
"""

from __future__ import annotations

import selectors
import shlex
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.launch.channel import PipeChannel
from madns_runtime import private_socket

BACKLOG = 4
FOLDER_PREFIX = "cosmos-"


class ManualLine:
    """
    Waits for one hand-started agent at a time; after it has gone, another may connect.

    Args:
        agent: Its name.
        selector: The operator's.
        launch: The launch line to give.
        on_line: Called with each line that it says.
        on_presence: Called with True when one has connected, with False when its connection has ended.
    """

    def __init__(
        self,
        agent: str,
        selector: selectors.BaseSelector,
        *,
        launch: Mapping[str, Any],
        on_line: Callable[[bytes], None],
        on_presence: Callable[[bool], None],
    ) -> None:
        self.agent = agent
        self._selector = selector
        self._launch = launch
        self._on_line = on_line
        self._on_presence = on_presence
        self.channel: PipeChannel | None = None
        self._folder = Path()
        self._listener: socket.socket | None = None

    def open(self) -> str:
        """
        Let an agent in, and return what to type into a shell.

        Raises:
            OSError: There can be no socket for it.
        """
        # Not in the run directory: a socket's path holds 108 bytes at most.
        folder = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX))
        path = folder / "launch"
        try:
            listener = private_socket.listen(folder, path.name, BACKLOG)
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self._folder, self._listener = folder, listener
        self._selector.register(listener, selectors.EVENT_READ, self._accept)
        return shlex.join(
            (sys.executable, "-P", "-m", "madns_runtime.agent", "--launch", str(path))
        )

    def send(self, command: Mapping[str, Any]) -> None:
        """Send a command to whoever is connected."""
        if self.channel is not None:
            self.channel.send(command)

    def stop_listening(self) -> None:
        """Let nobody in any more."""
        if self._listener is not None:
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = None
            shutil.rmtree(self._folder, ignore_errors=True)

    def close(self) -> None:
        """Close everything; an agent that is still there sees its life line end."""
        self.stop_listening()
        if self.channel is not None:
            self.channel.close()
            self.channel = None

    def _accept(self, mask: int) -> None:
        connection = None if self._listener is None else private_socket.accept(self._listener)
        if connection is None:
            return
        if self.channel is not None:
            connection.close()
            return
        fd = connection.detach()
        self.channel = PipeChannel(
            self._selector, (fd, fd), on_line=self._on_line, on_end=self._connection_ended
        )
        self.channel.send(self._launch)
        self._on_presence(True)

    def _connection_ended(self) -> None:
        self.channel = None
        self._on_presence(False)
