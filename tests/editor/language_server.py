"""A language server as an editor has it: a process that speaks JSON-RPC over its standard streams."""

import json
import subprocess
import threading


class LanguageServer:
    """
    yaml-language-server with documents open.

    Args:
        command: How it is started.
        folder: Where it works.
    """

    def __init__(self, command, folder, *, patience_s=120.0):
        self._process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        # A wait for a line has no deadline of its own.
        self._guard = threading.Timer(patience_s, self._process.kill)
        self._guard.start()
        self._number = 0
        self.published = {}
        self.ask("initialize", processId=None, rootUri=folder.as_uri(), capabilities=CAPABILITIES)
        self._tell("initialized")

    def close(self):
        """End it."""
        self._guard.cancel()
        self._process.kill()
        self._process.communicate()

    def open(self, path):
        """Open a document."""
        document = {
            "uri": path.as_uri(),
            "languageId": "yaml",
            "version": 1,
            "text": path.read_text(),
        }
        self._tell("textDocument/didOpen", textDocument=document)

    def at(self, request, path, line, column):
        """Return what the server says of a place, both counted from 1."""
        position = {"line": line - 1, "character": column - 1}
        return self.ask(
            f"textDocument/{request}", textDocument={"uri": path.as_uri()}, position=position
        )

    def faults(self, path):
        """Return what it finds wrong in a document, once it has said so."""
        while path.as_uri() not in self.published:
            self._take(self._read())
        return [each["message"] for each in self.published[path.as_uri()]]

    def ask(self, method, **parameters):
        """Return the result of a request."""
        self._number += 1
        number = self._number
        self._write({"id": number, "method": method, "params": parameters})
        while True:
            message = self._read()
            if message.get("id") == number and "method" not in message:
                assert "error" not in message, message
                return message["result"]
            self._take(message)

    def _tell(self, method, **parameters):
        self._write({"method": method, "params": parameters})

    def _take(self, message):
        if message.get("method") == "textDocument/publishDiagnostics":
            self.published[message["params"]["uri"]] = message["params"]["diagnostics"]
        elif "id" in message and "method" in message:  # it asks the editor: for settings, say
            items = message.get("params", {}).get("items", ())
            answer = [SETTINGS.get(item.get("section"), {}) for item in items]
            self._write({"id": message["id"], "result": answer})

    def _write(self, message):
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        self._process.stdin.write(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
        self._process.stdin.flush()

    def _read(self):
        size = 0
        while (line := self._process.stdout.readline()) != b"\r\n":
            assert line, "the language server has ended"
            if line.lower().startswith(b"content-length:"):
                size = int(line.partition(b":")[2])
        return json.loads(self._process.stdout.read(size))


CAPABILITIES = {
    "workspace": {"configuration": True},
    "textDocument": {
        "completion": {"completionItem": {"documentationFormat": ["markdown"]}},
        "hover": {"contentFormat": ["markdown"]},
    },
}
SETTINGS = {
    "yaml": {"validate": True, "hover": True, "completion": True, "schemaStore": {"enable": False}},
}
