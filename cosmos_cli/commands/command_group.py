"""
The group of all commands: finds the one that is meant, and makes of its function what typer runs.

A command's module is imported when it is invoked, so that quick commands stay quick, and a list of commands
takes what each one is for from its source.
"""

from __future__ import annotations

import ast
import copy
import gc
import importlib
import importlib.util
import math
from collections.abc import Iterator, Sequence
from typing import Any

import typer
import typer.core

from cosmos_cli.models.inventory_arguments import split_variable
from cosmos_cli.ui import invocation, step_times
from madns_runtime.similar_words import most_similar

COMMANDS = (
    "init",
    "validate",
    "schema",
    "plan",
    "inventory",
    "up",
    "ping",
    "facts",
    "doctor",
    "devices",
    "exec",
    "packages",
    "reboot",
    "wipe",
    "run",
    "test",
    "inject",
    "ps",
    "down",
    "logs",
    "runs",
    "collect",
    "judge",
    "report",
    "diff",
    "rerun",
    "tabulate",
    "bench",
)
GARBAGE_AFTER = 50_000
"""Objects made between two looks for garbage: what is imported later makes many, too."""
TIMED = (
    *("up", "ping", "facts", "doctor", "exec", "packages", "reboot", "wipe"),
    *("run", "collect", "logs", "ps", "down"),
)
"""Commands that take -v: they do one thing after the other, here and on machines."""
USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""Typer carries its own click since 0.2x: click's own class would not match."""


class LazyGroup(typer.core.TyperGroup):
    """The command group: `cosmos_cli.commands.<verb>` holds a function of the verb's name."""

    verbs: Sequence[str] = COMMANDS
    prefix = ""
    """Verb of a group within the group, and a space."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the verbs in the order in which one meets them."""
        return list(self.verbs)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import one command and build it; None for an unknown one."""
        if cmd_name not in self.verbs:
            return None
        if cmd_name not in self.commands:
            self.commands[cmd_name] = load_command(f"{self.prefix}{cmd_name}")
        return self.commands[cmd_name]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the commands, none of which is imported."""
        outlines = {verb: command_outline(f"{self.prefix}{verb}") for verb in self.verbs}
        typer.core.TyperGroup(name=self.name, commands=outlines).format_commands(ctx, formatter)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; typer would make a silent exit code of Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command that is meant; typer looks for similar names among loaded ones only."""
        if args and args[0] not in self.verbs and not args[0].startswith("-"):
            close = most_similar(args[0], self.verbs)
            hint = f"did you mean {close}?" if close else f"there are {', '.join(self.verbs)}"
            raise USAGE_ERROR(f"no command {self.prefix + args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)


class StrictCommand(typer.core.TyperCommand):
    """A command that refuses an option given twice where one value counts: the first would be dropped in silence."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command's words, which are remembered first: how an error in them is told depends on them."""
        invocation.record(
            str(self.name),
            args,
            frozenset(name for p in self.params if _takes_value(p) for name in p.opts),
            has_tail=not ctx.allow_interspersed_args,
        )
        seen: set[str] = set()
        for parameter in self.make_parser(ctx).parse_args(args=list(args))[2]:
            name = str(parameter.name)
            if name in seen and _counts_once(parameter):
                words = "/".join([*parameter.opts[:1], *parameter.secondary_opts[:1]])
                hint = f"; join the patterns: {words} 'A,B'" if name == "limit" else ""
                raise USAGE_ERROR(f"{words} is given twice, and only one could count{hint}", ctx)
            seen.add(name)
        return super().parse_args(ctx, args)


def _takes_value(parameter: Any) -> bool:
    is_option = parameter.param_type_name == "option"
    return is_option and not (parameter.is_flag or parameter.count)


def _counts_once(parameter: Any) -> bool:
    """Whether a second value would replace the first; a flag says the same however often it is given."""
    if parameter.param_type_name != "option" or parameter.multiple or parameter.count:
        return False
    return not parameter.is_flag or bool(parameter.secondary_opts)


def command_outline(verb: str) -> Any:
    """Return a command that knows its help alone, read from its source: to import all commands takes half a second."""
    spec = importlib.util.find_spec(_module_of(verb))
    source: Any = spec and spec.loader
    tree = ast.parse(source.get_source(_module_of(verb)))
    name = verb.rpartition(" ")[2]
    (function,) = (
        node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name
    )
    return typer.core.TyperCommand(name=name, help=ast.get_docstring(function))


def load_command(verb: str) -> Any:
    """Import `cosmos_cli.commands.<verb>` and return its function as a command, or as a group of its SUBCOMMANDS."""
    module = importlib.import_module(_module_of(verb))
    _collect_garbage()
    function = getattr(module, verb.rpartition(" ")[2])
    if hasattr(module, "SUBCOMMANDS"):
        return _as_group(function, verb, module.SUBCOMMANDS)
    settings = getattr(module, "CONTEXT_SETTINGS", None)
    command = _as_command(function, name=verb, cls=StrictCommand, context_settings=settings)
    if verb in TIMED:
        command.params.append(_verbose_option())
    for parameter in command.params:
        parameter.callback = parameter.callback or _refuse_not_finite
        if parameter.envvar == invocation.INVENTORY_VARIABLE:
            parameter.type = _with_own_split(parameter.type)
    return command


def _module_of(verb: str) -> str:
    return f"cosmos_cli.commands.{verb.replace(' ', '_')}"


def _collect_garbage() -> None:
    """Begin to look for garbage, unless that goes on already, but not among all that was imported: it stays."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
    gc.set_threshold(GARBAGE_AFTER)


def _verbose_option() -> Any:
    """Return the option -v, which is the same for every command and no command's affair."""

    def told(
        verbose: int = typer.Option(
            0,
            *("--verbose", "-v"),
            count=True,
            max=step_times.VERBOSITY_MAX,
            clamp=True,
            expose_value=False,
            callback=step_times.set_verbosity,
            show_default=False,
            help="Say on stderr how long each step of each machine took; -vv: each question, too.",
        ),
    ) -> None:
        """Hold the option."""

    return next(option for option in _as_command(told).params if option.name == "verbose")


def each_command() -> Iterator[tuple[str, Any]]:
    """Yield every command with its words, those of groups within the group as well."""
    for verb in COMMANDS:
        command = load_command(verb)
        if isinstance(command, LazyGroup):
            yield from (
                (f"{verb} {name}", load_command(f"{verb} {name}")) for name in command.verbs
            )
        else:
            yield verb, command


def _as_group(function: Any, verb: str, verbs: Sequence[str]) -> Any:
    """Return a group within the group; its commands stand in `cosmos_cli.commands.<verb>_<subcommand>`."""
    app = typer.Typer(
        name=verb, cls=LazyGroup, add_completion=False, no_args_is_help=True, rich_markup_mode=None
    )
    app.callback()(function)
    group: Any = typer.main.get_command(app)
    group.verbs, group.prefix = verbs, f"{verb} "
    return group


def _as_command(function: Any, **settings: Any) -> Any:
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    single.command(**settings)(function)
    return typer.main.get_command(single)


def _with_own_split(kind: Any) -> Any:
    """Return an option's type that reads several inventories from one variable; the original is shared by all texts."""
    own = copy.copy(kind)
    own.split_envvar_value = split_variable
    return own


def _refuse_not_finite(context: Any, parameter: Any, value: Any) -> Any:
    """Return an option's value; every range lets nan pass, and nobody means it or infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        raise typer.BadParameter(f"expected a finite number, got {value}", context, parameter)
    return value
