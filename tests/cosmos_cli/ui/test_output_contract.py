"""Nothing is printed past the console, which cleans all of it; read from the source of every module."""

import ast
import re
from pathlib import Path

import cosmos_cli

PACKAGE = Path(cosmos_cli.__file__).parent
ON_MACHINES = PACKAGE / "onboard"
"""Its standard output is the wire to the operator's side, which cleans what it prints of it."""
OUTPUT = {"ui/console.py", "ui/rich_console.py"}
HANDED_ON = {"view/factory.py"}
"""Hands standard error to a view, which writes through the console."""
BEFORE_ALL = {
    "start.py": [
        "if sys.stderr is not None:\n    sys.stderr.flush()",
        "os.write(2, f'error: {memory_text()}\\n'.encode())",
        "sys.stderr.write('interrupted\\n')",
    ]
}
"""The only other words, all our own: while nothing is imported yet, where there is no memory to do it, and the last flush."""
FORBIDDEN_CALLS = {
    "print",
    "input",
    "typer.echo",
    "typer.secho",
    "typer.confirm",
    "typer.prompt",
    "typer.style",
    "traceback.print_exc",
    "traceback.print_exception",
    "rich.print",
    "os.writev",
}
FORBIDDEN_IMPORTS = {
    ("rich.console", "Console"),
    ("rich.text", "Text"),
    ("rich", "print"),
    ("rich", "print_json"),
    ("rich", "get_console"),
    ("click", "*"),
    ("sys", "stdout"),
    ("sys", "stderr"),
}
READERS = {"is_terminal", "paint"}


def modules():
    return [path for path in sorted(PACKAGE.rglob("*.py")) if not path.is_relative_to(ON_MACHINES)]


def name_of(path):
    return path.relative_to(PACKAGE).as_posix()


def faults(path):
    # Of a template, the words that `cosmos init` fills in are no Python.
    tree = ast.parse(re.sub(r"@([A-Z]+)@", r"\1", path.read_text(encoding="utf-8")))
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and is_forbidden(node):
            yield f"{name_of(path)}:{node.lineno}: {ast.unparse(node)}"
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if {(node.module, alias.name), (node.module, "*")} & FORBIDDEN_IMPORTS:
                    yield f"{name_of(path)}:{node.lineno}: {ast.unparse(node)}"
        if isinstance(node, ast.Attribute) and ast.unparse(node) in ("sys.stdout", "sys.stderr"):
            parent = parents[node]
            is_read = isinstance(parent, ast.Call) and ast.unparse(parent.func) in READERS
            is_flush = isinstance(parent, ast.Attribute) and parent.attr in ("flush", "isatty")
            if not is_read and not is_flush:
                call = parents[parent]
                yield f"{name_of(path)}:{node.lineno}: {ast.unparse(call)}"


def is_forbidden(call):
    called = ast.unparse(call.func)
    if called == "traceback.print_exc" and any(word.arg == "file" for word in call.keywords):
        return False
    if called == "os.write" and isinstance(call.args[0], ast.Constant):
        return True
    return called in FORBIDDEN_CALLS


def test_every_module_prints_through_the_console_alone():
    found = {name_of(path): list(faults(path)) for path in modules()}

    assert len(found) > 300
    for name, expected in BEFORE_ALL.items():
        assert sorted(text.split(": ", 1)[1] for text in found.pop(name)) == expected
    for name in HANDED_ON:
        handed_on = found.pop(name)
        assert all(re.search(r"return (\w*View|kind)\(sys\.stderr, ", text) for text in handed_on)
    others = {
        name: texts
        for name, texts in found.items()
        if texts and name not in OUTPUT and not name.startswith("templates/")
    }
    assert others == {}


def test_contract_sees_what_it_forbids(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.PACKAGE", tmp_path)
    bad = tmp_path / "bad.py"
    lines = [
        "print(1)",
        "sys.stdout.write('a')",
        "out = sys.stderr",
        "typer.echo('a')",
        "from rich.console import Console",
        "from rich.text import Text",
        "traceback.print_exc()",
        "os.write(1, b'')",
        "from sys import stderr",
    ]
    bad.write_text("\n".join(lines))

    assert sorted(int(text.split(":")[1]) for text in faults(bad)) == list(range(1, len(lines) + 1))
