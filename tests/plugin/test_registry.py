import dataclasses
import pickle  # noqa: TID251 - shows that executor workers can find a file's functions again
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from madns_runtime.errors import ConfigurationError, MissingExtraError, PluginError
from madns_runtime.hardware import kind_registry
from madns_runtime.plugin import registry, time_limit
from madns_runtime.plugin.api import ActionKind, Simulation


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Brake:
    """Parameters of an action."""


PLUGIN = """
    from __future__ import annotations
    from dataclasses import dataclass
    from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Parameters:
        gain: float = 2.0
        marks: tuple[int, ...] = ()

    class Host(HostSimulation):
        pass

    class Agent(AgentSimulation):
        pass

    def work(x):
        return x + 1

    simulation = Simulation(name="p", parameters=Parameters, agent=":Agent", host=":Host")
"""


@pytest.fixture
def write(tmp_path):
    def write_file(text, name="plugin.py"):
        path = tmp_path / name
        path.write_text(textwrap.dedent(text))
        return path

    yield write_file
    for name in [
        n for n, m in sys.modules.items() if str(tmp_path) in str(getattr(m, "__file__", ""))
    ]:
        del sys.modules[name]


def refusal(spec, base):
    with pytest.raises(PluginError) as caught:
        registry.resolve(spec, base)
    return str(caught.value)


def half_refusal(write, tmp_path, body):
    write(PLUGIN + textwrap.indent(textwrap.dedent(body), "    "))
    descriptor = registry.resolve("./plugin.py:simulation", tmp_path)
    with pytest.raises(PluginError) as caught:
        registry.load_half(descriptor, "agent", tmp_path)
    return str(caught.value)


def test_registered_name_is_found(tmp_path):
    descriptor = registry.resolve("counter", tmp_path)

    assert descriptor.name == "counter"
    assert {"counter", "constellation"} <= set(registry.registered_names())


def install(folder, name, value, *, group="madns.simulations"):
    """Install metadata of a distribution that registers two-grids in a group, and put its folder on the path."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\ntwo-grids = {value}\n")


@pytest.mark.parametrize(
    ("group", "find"),
    [("madns.simulations", registry.resolve), ("madns.devices", kind_registry.resolve_kind)],
)
def test_name_of_two_distributions_is_refused_with_both_of_them(tmp_path, monkeypatch, group, find):
    install(tmp_path / "a", "grid-nodes", "grid_nodes:simulation", group=group)
    install(tmp_path / "b", "grid-two", "grid_two:simulation", group=group)
    monkeypatch.syspath_prepend(tmp_path / "a")
    monkeypatch.syspath_prepend(tmp_path / "b")

    with pytest.raises(PluginError) as caught:
        find("two-grids", tmp_path)

    assert str(caught.value).startswith("'two-grids' is registered by more than one distribution: ")
    for told in ("grid-nodes 1.0 (grid_nodes:simulation)", "grid-two 1.0 (grid_two:simulation)"):
        assert told in str(caught.value)


def test_name_that_two_distributions_register_for_one_place_is_that_place(tmp_path, monkeypatch):
    place = "madns_runtime.simulations.counter:simulation"
    for name in ("grid-old", "grid-new"):
        install(tmp_path, name, place)
    monkeypatch.syspath_prepend(tmp_path)

    assert registry.resolve("two-grids", tmp_path).name == "counter"


def test_module_and_attribute_are_found(tmp_path):
    by_module = registry.resolve("madns_runtime.simulations.counter:simulation", tmp_path)

    assert by_module == registry.resolve("counter", tmp_path)


def test_unknown_name_lists_known_ones_and_the_closest(tmp_path):
    message = refusal("conter", tmp_path)

    assert message.startswith("no simulation named 'conter', did you mean counter?")
    assert "installed are constellation, counter" in message


def test_name_of_a_file_beside_the_scenario_tells_how_files_are_written(write, tmp_path):
    write(PLUGIN, "rover.py")

    assert "a file's simulation is written ./rover.py:simulation" in refusal("rover", tmp_path)
    assert "a file's simulation is written ./rover.py:simulation" in refusal("rover.py", tmp_path)


def test_file_beside_the_scenario_is_found_and_its_parts_are_named_in_full(write, tmp_path):
    path = write(PLUGIN)

    descriptor = registry.resolve("./plugin.py:simulation", tmp_path)

    assert isinstance(descriptor, Simulation)
    assert descriptor.agent == f"{registry.module_name(path)}:Agent"
    assert registry.load_half(descriptor, "agent", tmp_path).__name__ == "Agent"
    assert registry.load_half(descriptor, "host", tmp_path).__name__ == "Host"


def test_file_is_loaded_once_and_its_functions_can_be_found_by_name(write, tmp_path):
    write(PLUGIN)

    first = registry.resolve("./plugin.py:simulation", tmp_path)
    second = registry.resolve("./plugin.py:simulation", tmp_path)

    work = registry.load_function("./plugin.py:work", tmp_path)
    assert first.parameters is second.parameters
    assert pickle.loads(pickle.dumps(work)) is work


def test_files_of_one_name_in_two_folders_are_two_modules(tmp_path):
    paths = [tmp_path / folder / "plugin.py" for folder in ("a", "b")]

    assert len({registry.module_name(path) for path in paths}) == 2


@pytest.mark.process
def test_module_name_is_the_same_in_every_process(tmp_path):
    path = tmp_path / "my-plugin.py"
    code = (
        "from pathlib import Path; from madns_runtime.plugin.registry import module_name;"
        f"print(module_name(Path({str(path)!r})))"
    )

    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert other.stdout.strip() == registry.module_name(path)
    assert registry.module_name(path).isidentifier()


def test_missing_file_is_named(tmp_path):
    assert str(tmp_path / "no.py") in refusal("./no.py:simulation", tmp_path)


def test_path_that_no_file_can_have_is_told(tmp_path):
    assert "expected a path without NUL characters" in refusal("./a\0b.py:simulation", tmp_path)


def test_syntax_error_is_shown_with_file_and_line(write, tmp_path):
    path = write("x = 1\ndef broken(:\n")

    assert refusal("./plugin.py:simulation", tmp_path).startswith(f"{path}:2: SyntaxError: ")


def test_error_while_loading_is_shown_with_the_line_of_the_file(write, tmp_path):
    path = write("def inner():\n    return 1 / 0\n\n\ninner()\n")

    message = refusal("./plugin.py:simulation", tmp_path)

    assert message == f"{path}:2: ZeroDivisionError: division by zero"


def test_file_that_failed_is_read_again_after_a_repair(write, tmp_path):
    write("raise ValueError('not yet')\n")
    refusal("./plugin.py:simulation", tmp_path)
    write(PLUGIN)

    assert registry.resolve("./plugin.py:simulation", tmp_path).name == "p"


def test_missing_module_in_a_file_is_shown_with_its_line(write, tmp_path):
    path = write("import os\nimport no_such_module_at_all\n")

    message = refusal("./plugin.py:simulation", tmp_path)

    assert message == f"{path}:2: No module named 'no_such_module_at_all'"


@pytest.mark.parametrize(
    ("line", "limit_s", "told"),
    [
        ("os._exit(0)", 60.0, "it called os._exit(0)"),
        ("while True: pass", 2.0, "it was not done within 2 s"),  # for it to come to this line
    ],
)
def test_installed_module_that_is_stopped_while_it_is_imported_is_told_with_its_own_line(
    tmp_path, monkeypatch, line, limit_s, told
):
    (tmp_path / "stopped_while_imported.py").write_text(f"import os\n\n{line}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(time_limit, "_limit_s", limit_s)

    with pytest.raises(PluginError) as caught:
        registry.resolve("stopped_while_imported:simulation", tmp_path)

    assert f"{tmp_path}/stopped_while_imported.py:3: {told}" in str(caught.value)


def test_missing_extra_names_the_command_that_installs_it(write, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)  # import then says that it is not there
    write(
        """
        try:
            import scipy
        except ModuleNotFoundError:
            raise ModuleNotFoundError("No module named 'scipy'", name="scipy")
        """
    )

    with pytest.raises(MissingExtraError) as caught:
        registry.resolve("./plugin.py:simulation", tmp_path)

    assert "pip install 'cosmos-madns[host]'" in str(caught.value)


def test_missing_attribute_suggests_the_closest(write, tmp_path):
    write(PLUGIN)

    message = refusal("./plugin.py:simulaton", tmp_path)

    assert "has no 'simulaton', did you mean simulation?" in message


@pytest.mark.parametrize("spec", ["a b:", ":simulation", "./plugin.py:", "x:y-z"])
def test_malformed_spec_is_refused(spec, tmp_path):
    assert "expected module:attribute or ./file.py:attribute" in refusal(spec, tmp_path)


def test_something_else_than_a_descriptor_is_refused(write, tmp_path):
    write(PLUGIN)

    message = refusal("./plugin.py:Agent", tmp_path)

    assert "expected a madns_runtime.plugin.api.Simulation, got" in message


def test_every_fault_of_a_descriptor_is_named(write, tmp_path):
    write(PLUGIN + "    bad = Simulation(name='p', parameters=3, agent='Agent', host='Host')\n")

    message = refusal("./plugin.py:bad", tmp_path)

    assert "parameters: expected a dataclass" in message
    assert "agent: expected 'module:name' or ':name', got 'Agent'" in message
    assert "host: expected" in message


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("streams", ", none of schema, runs,"),
        ("", " of at most 200 printable characters, got ''"),
        (3, " of at most 200 printable characters, got 3"),
    ],
)
def test_simulation_that_is_called_like_a_key_of_a_comparison_or_nothing_is_refused(
    write, tmp_path, name, words
):
    write(PLUGIN + f"    bad = Simulation(name={name!r}, parameters=Parameters, agent=':Agent')\n")

    assert f"name: expected a text{words}" in refusal("./plugin.py:bad", tmp_path)


def test_agent_without_the_methods_of_the_contract_is_refused(write, tmp_path):
    message = half_refusal(
        write,
        tmp_path,
        """
        class Agent:
            def setup(self, context, initial): pass
            def receive(self, message): pass
        """,
    )

    assert "no method step()" in message
    assert "no method finish()" in message
    assert "subclass AgentSimulation to inherit what is not needed" in message


def test_method_that_a_run_may_call_late_or_never_is_looked_at_like_any_other(write, tmp_path):
    message = half_refusal(
        write,
        tmp_path,
        """
        class Agent(AgentSimulation):
            def step(self, tick): pass
            def hear(self): pass
            def refused(self, refusal, why): pass
            def device_changed(self, device): pass
            def begin_action(self): pass
            def abandon(self, reason): pass
        """,
    )

    for wanted in (
        "hear() must take (self, delivery)",
        "refused() must take (self, refusal)",
        "device_changed() must take (self, device, status)",
        "begin_action() must take (self, action)",
        "abandon() must take (self)",
    ):
        assert wanted in message


@pytest.mark.parametrize(
    ("body", "is_refused"),
    [
        ("class Agent(AgentSimulation): pass", True),
        ("class Agent(AgentSimulation):\n    def begin_actions(self, action): pass", True),
        ("class Agent(AgentSimulation):\n    def begin_action(self, action): pass", False),
    ],
)
def test_a_half_that_carries_out_declared_actions_has_the_method(write, tmp_path, body, is_refused):
    write(PLUGIN + textwrap.indent(body, "    "))
    descriptor = registry.resolve("./plugin.py:simulation", tmp_path)
    brake = ActionKind(
        word="brake", summary="Brakes.", parameters=Brake, lasting="never", carried_out_by="agent"
    )
    acting = dataclasses.replace(descriptor, actions=(brake,))

    registry.load_half(descriptor, "agent", tmp_path)
    if not is_refused:
        registry.load_half(acting, "agent", tmp_path)
        return
    with pytest.raises(PluginError, match=r"no method begin_action\(\) of its own, .*out brake"):
        registry.load_half(acting, "agent", tmp_path)
    of_host = dataclasses.replace(brake, carried_out_by="host")
    idle = dataclasses.replace(acting, host=None, actions=(of_host,))
    with pytest.raises(PluginError, match=r"host: expected a class that carries out brake, got"):
        registry.load_half(idle, "host", tmp_path)


def test_method_with_other_parameters_is_refused(write, tmp_path):
    message = half_refusal(
        write,
        tmp_path,
        """
        class Agent(AgentSimulation):
            def step(self): pass
        """,
    )

    assert "step() must take (self, tick)" in message


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("async def step(self, tick): pass", "step() must be a plain def: nobody awaits it"),
        ("def step(self, tick): yield", "step() must not yield: nobody asks it for values"),
        ("async def hear(self, delivery): yield", "hear() must not yield"),
    ],
)
def test_method_whose_call_runs_nothing_is_refused(write, tmp_path, method, words):
    message = half_refusal(
        write,
        tmp_path,
        f"""
        class Agent(AgentSimulation):
            {method}
        """,
    )

    assert words in message


def test_class_with_arguments_is_refused(write, tmp_path):
    message = half_refusal(
        write,
        tmp_path,
        """
        class Agent(AgentSimulation):
            def __init__(self, name): pass
        """,
    )

    assert "it must be made without arguments" in message


def test_function_in_place_of_a_class_is_refused(write, tmp_path):
    message = half_refusal(write, tmp_path, "def Agent(): pass\n")

    assert "expected a class, got function" in message


def test_simulation_without_a_host_half_gets_an_idle_one(tmp_path):
    descriptor = Simulation(name="x", parameters=object, agent="m:A")

    host = registry.load_half(descriptor, "host", tmp_path)()

    assert host.timer(0.0) is None
    assert host.initial_data("agent-01") == {}


@pytest.mark.parametrize("role", ["host", "agent"])
def test_shipped_counter_keeps_the_contract(role, tmp_path):
    descriptor = registry.resolve("counter", tmp_path)

    assert isinstance(registry.load_half(descriptor, role, tmp_path)(), object)


def test_parameters_are_built_from_a_plain_mapping(write, tmp_path):
    write(PLUGIN)
    descriptor = registry.resolve("./plugin.py:simulation", tmp_path)

    parameters = registry.parse_parameters(descriptor, {"gain": 3, "marks": [1, 2]})

    assert dataclasses.asdict(parameters) == {"gain": 3.0, "marks": (1, 2)}


def test_unknown_parameter_is_refused_by_the_runtime_too(write, tmp_path):
    write(PLUGIN)
    descriptor = registry.resolve("./plugin.py:simulation", tmp_path)

    with pytest.raises(ConfigurationError, match="parameters: unknown gian"):
        registry.parse_parameters(descriptor, {"gian": 3})


@pytest.mark.process
def test_resolving_a_registered_simulation_imports_neither_numpy_nor_the_halves():
    code = (
        "import sys; from pathlib import Path; from madns_runtime.plugin.registry import resolve;"
        "resolve('counter', Path()); resolve('constellation', Path());"
        "print([m for m in ('numpy', 'scipy', 'sgp4', 'pydantic', 'yaml') if m in sys.modules])"
    )

    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )

    assert result.stdout.strip() == "[]"


def test_registry_needs_only_a_path_to_find_a_file(write, tmp_path):
    write(PLUGIN)

    by_absolute_path = registry.resolve(f"{tmp_path / 'plugin.py'}:simulation", Path("/"))

    assert by_absolute_path.name == "p"


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ("['a.b']", r"columns: expected a tuple of texts 'stream.field', got \['a.b'\]"),
        ("('speed_m_s',)", "columns: expected a tuple of texts 'stream.field'"),
        ("7 * ('a.b',)", "columns: expected at most 6, got 7"),
    ],
)
def test_columns_that_are_no_fields_of_streams_are_told(write, tmp_path, columns, told):
    write(PLUGIN.replace('host=":Host")', f'host=":Host", columns={columns})'))

    with pytest.raises(PluginError, match=told):
        registry.resolve("./plugin.py:simulation", tmp_path)


@pytest.mark.parametrize(
    ("field", "told"),
    [
        ("name=5", "name: expected a text"),
        (r"name='\ud800'", "name: expected a text"),
        ("label_column='t_s'", "label_column: tables have a column 't_s' already"),
        ("label_column=None", "label_column: expected a text"),
        ("actions=5", "actions: expected a tuple of ActionKind, got 5"),
        ("actions=(K(word=5, summary='x'),)", "actions: 5: word: expected a text, got 5"),
        ("actions=(K(word='x', summary='x', lasting='ever'),)", "'x': lasting: expected never,"),
        ("actions=(K(word='x', summary='x', modes='lockstep'),)", "'x': modes: expected a tuple"),
        (
            "actions=(K(word='x', summary='x', parameters=Taken),)",
            "x.parameters: for_s: no parameter can be called so",
        ),  # fmt: skip
        ("agent_parameters='gain'", "agent_parameters: expected a tuple of parameters' names"),
        ("agent_parameters=('gian',)", "agent_parameters: there is no parameter 'gian'"),
        ("placeholders={'gain': 'name'}", "placeholders: expected a mapping"),
        ("check=len", "check: expected 'module:name' or ':name'"),
    ],
)
def test_a_field_of_a_descriptor_that_is_no_such_value_is_told(write, tmp_path, field, told):
    write(
        PLUGIN.rstrip().removesuffix(")") + f", {field})\n"
        if "name=" not in field
        else PLUGIN.replace('name="p"', field)
    )
    text = (tmp_path / "plugin.py").read_text()
    (tmp_path / "plugin.py").write_text(
        text.replace(
            "from dataclasses import dataclass",
            "from dataclasses import dataclass\nfrom madns_runtime.timeline.action import ActionKind as K"
            "\n@dataclass(frozen=True)\nclass Taken:\n    for_s: float = 1.0",
        )
    )

    assert told in refusal("./plugin.py:simulation", tmp_path)


LOADING = """
import os, sys
from pathlib import Path
from madns_runtime.errors import PluginError
from madns_runtime.plugin.registry import load_object

parent = os.getpid()
try:
    load_object("./forking.py:Half", Path(sys.argv[1]))
except PluginError as error:
    os.write(1, f"{error}\\n".encode())
else:
    os.write(1, f"loaded in the {'parent' if os.getpid() == parent else 'copy'}\\n".encode())
"""


@pytest.mark.process
def test_a_module_that_forks_is_loaded_in_the_parent_and_refused_in_the_copy_that_came_back(
    tmp_path,
):
    (tmp_path / "forking.py").write_text("import os\n\nos.fork()\n\n\nclass Half:\n    pass\n")

    done = subprocess.run(
        [sys.executable, "-c", LOADING, tmp_path], capture_output=True, text=True, timeout=120
    )

    assert done.stderr == ""
    assert sorted(done.stdout.splitlines()) == [
        "./forking.py:Half: when it was imported, it forked a process that came back from the call;"
        " let such a process end itself by os._exit(0)",
        "loaded in the parent",
    ]
