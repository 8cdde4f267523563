"""Faults of what a plug-in does outside of a run: while it is imported, in check and in demand."""

import re
import signal
import sys
import textwrap

import pytest

from madns_runtime.errors import PluginError
from madns_runtime.plugin import code_places, isolation, registry
from madns_runtime.plugin.queries import (
    ask_check,
    ask_demand,
    ask_device_uses,
    ask_labels,
    ask_streams,
)

HEAD = """\
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, Demand, Flow, Simulation
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    gain: float = 2.0
class Agent(AgentSimulation):
    pass
simulation = Simulation(
    name="p", parameters=Parameters, agent=":Agent", check=":check", demand=":demand"
)
def check(parameters, agents, base_directory):
    return []
def demand(parameters, agents, tick_hz, base_directory):
    return None
"""
LAST_LINE = HEAD.count("\n")


@pytest.fixture
def plugin(tmp_path):
    """Return a function that writes a plug-in of HEAD and more; it returns the file."""

    def write(more="", *, head=HEAD, name="plugin.py"):
        path = tmp_path / name
        path.write_text(head + textwrap.dedent(more))
        return path

    yield write
    for name in [
        n for n, m in sys.modules.items() if str(tmp_path) in str(vars(m).get("__file__"))
    ]:
        del sys.modules[name]


def ask(path, question):
    where = f"{path}:{question}"
    if question == "check":
        return ask_check(where, path.parent, parameters=None, agents=3)
    return ask_demand(where, path.parent, parameters=None, agents=3, tick_hz=10.0)


def refusal(path, question):
    with pytest.raises(PluginError) as caught:
        ask(path, question)
    return str(caught.value)


def test_plugin_that_ends_the_process_while_it_is_imported_is_to_blame(plugin):
    path = plugin("import sys\nsys.exit(0)\n", head="")

    with pytest.raises(PluginError) as caught:
        registry.resolve(f"{path}:simulation", path.parent)

    assert str(caught.value) == f"{path}:2: it called sys.exit(0)"


def test_installed_module_that_ends_the_process_is_to_blame(plugin, monkeypatch):
    path = plugin("raise SystemExit\n", head="", name="ends_at_once.py")
    monkeypatch.syspath_prepend(path.parent)

    with pytest.raises(PluginError, match=r"ends_at_once.py:1: it called sys.exit\(\)"):
        registry.resolve("ends_at_once:simulation", path.parent)


def test_what_a_plugin_prints_while_it_is_loaded_or_asked_goes_to_stderr(plugin, capsys):
    path = plugin("""
        print("while importing")
        def check(*_):
            print("while checking")
            yield "gain: odd"
    """)

    assert ask(path, "check") == ["gain: odd"]

    assert capsys.readouterr() == ("", "while importing\nwhile checking\n")


@pytest.mark.parametrize("question", ["check", "demand"])
@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("return 1 / 0", "ZeroDivisionError: division by zero"),
        ("import sys; sys.exit(0)", "it called sys.exit(0)"),
    ],
)
def test_question_that_raises_is_told_with_its_line(plugin, question, body, said):
    path = plugin(f"def {question}(*_):\n    {body}\n")

    assert refusal(path, question) == f"{path}:{LAST_LINE + 2}: {question}(): {said}"


def test_check_with_a_fourth_parameter_names_is_given_the_agents_names(plugin):
    path = plugin("def check(p, n, base, names): return [*names, str(n)]")
    where = f"{path}:check"

    found = ask_check(where, path.parent, parameters=None, agents=2, names=("a", "b"))

    assert found == ["a", "b", "2"]


def test_check_with_a_fifth_parameter_duration_s_is_given_the_runs_duration(plugin):
    path = plugin("def check(p, n, base, names, duration_s): return [f'{names} {duration_s}']")
    where = f"{path}:check"

    found = ask_check(where, path.parent, parameters=None, agents=1, names=("a",), duration_s=60.0)

    assert found == ["('a',) 60.0"]


def test_check_is_given_by_name_what_it_takes_by_name_alone(plugin):
    path = plugin(
        "def check(p, n, base, *, tick_hz, names, other=7): return [f'{names} {tick_hz} {other}']"
    )
    where = f"{path}:check"

    found = ask_check(where, path.parent, parameters=None, agents=1, names=("a",), tick_hz=5.0)

    assert found == ["('a',) 5.0 7"]


def test_check_by_name_that_raises_is_told_with_its_line(plugin):
    path = plugin("def check(p, n, base, *, names):\n    raise ValueError('late')\n")

    assert refusal(path, "check") == f"{path}:{LAST_LINE + 2}: check(): ValueError: late"


def test_check_that_raises_while_it_yields_is_told_with_its_line(plugin):
    path = plugin("def check(*_):\n    yield 'a: b'\n    raise ValueError('late')\n")

    assert refusal(path, "check") == f"{path}:{LAST_LINE + 3}: check(): ValueError: late"


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("return 3", "must return DeclaredStreams of madns_runtime.plugin.api, got 3"),
        ("return [D(role='agent', name='ticks', fields=())]", "which belongs to the framework"),
        ("return 2 * [D(role='host', name='a', fields=())]", "which belongs to another of them"),
        ("return [D(role='chief', name='a', fields=())]", "of role host or agent, got ('chief'"),
        ("return [D(role='host', name='a', fields=(3,))]", "fields as a tuple of Field, got (3,)"),
    ],
)
def test_streams_that_are_no_declaration_are_told(plugin, body, told):
    path = plugin(f"""
from madns_runtime.plugin.api import DeclaredStream as D
def streams(parameters, agents):
    {body}
""")

    with pytest.raises(PluginError, match=re.escape(told)):
        ask_streams(f"{path}:streams", path.parent, parameters=None, agents=("a",))


@pytest.mark.parametrize("value", ["None", "{'b': 'x'}", "{'a': 3}", "{'a': ''}"])
def test_labels_that_are_no_second_names_are_told(plugin, value):
    path = plugin(f"def labels(parameters, agents, base):\n    return {value}\n")
    told = f"labels() must return a mapping of agents' names to texts, got {value}"

    with pytest.raises(PluginError, match=re.escape(told)):
        ask_labels(f"{path}:labels", path.parent, parameters=None, agents=("a",))


@pytest.mark.parametrize(
    "value", ["None", "3", "[3]", "[U(agent='b', field='f', device='d', channel='c')]"]
)
def test_uses_of_devices_that_are_none_are_told(plugin, value):
    path = plugin(f"""
from madns_runtime.plugin.api import DeviceUse as U
def uses(parameters, agents, base):
    return {value}
""")
    told = (
        "device_uses() must return DeviceUses of madns_runtime.plugin.api by agents of the scenario"
    )

    with pytest.raises(PluginError, match=re.escape(told)):
        ask_device_uses(f"{path}:uses", path.parent, parameters=None, agents=("a",))


def test_uses_of_devices_are_those_of_the_agents(plugin):
    path = plugin("""
from madns_runtime.plugin.api import DeviceUse
def uses(parameters, agents, base):
    for agent in agents:
        yield DeviceUse(agent=agent, field="parameters.gyro", device="imu", channel="rate")
""")

    uses = ask_device_uses(f"{path}:uses", path.parent, parameters=None, agents=("a", "b"))

    assert [use.agent for use in uses] == ["a", "b"]


@pytest.mark.parametrize("value", ["None", "3", "'gain: odd'", "[3]"])
def test_check_that_returns_no_list_of_texts_is_told_with_its_place(plugin, value):
    path = plugin(f"def check(*_):\n    return {value}\n")

    message = refusal(path, "check")

    assert message.startswith(f"{path}:{LAST_LINE + 1}: check() must return a list of texts")
    assert message.endswith(f"got {value}")


@pytest.mark.parametrize(
    ("field", "value"),
    [("buffer_s", "'1'"), ("lead_s", "float('nan')"), ("batch_bytes", "-1"), ("flows", "3")],
)
def test_demand_with_a_bad_figure_is_told_with_its_place(plugin, field, value):
    path = plugin(f"""
        GOOD = dict(flows=(Flow(name="a", message_bytes=3, rate_hz=1.0),), buffer_s=1.0,
            batch_bytes=0, batch_compute_s=0.0, sync_bytes=0, sync_compute_s=0.0,
            sync_rate_hz=0.0, lead_s=0.0, measured=False)
        def demand(*_):
            return Demand(**GOOD | {{"{field}": {value}}})
    """)

    message = refusal(path, "demand")

    assert message.startswith(f"{path}:{LAST_LINE + 5}: demand() must return")
    assert field in message


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *((field, "float('inf')") for field in ("batch_bytes", "batch_compute_s", "sync_bytes")),
        *((field, "float('inf')") for field in ("sync_compute_s", "sync_rate_hz", "sync_bytes")),
        *((field, "10**400") for field in ("buffer_s", "batch_bytes", "lead_s")),
        *((field, "10**5000") for field in ("buffer_s", "batch_bytes")),
        ("flows", "(Flow(name='a', message_bytes=float('inf'), rate_hz=1),)"),
        ("flows", "(Flow(name='a', message_bytes=1, rate_hz=10**400),)"),
        ("flows", "(Flow(name=3, message_bytes=1, rate_hz=1),)"),
        ("flows", "[10**5000]"),
    ],
)
def test_demand_beyond_all_measure_is_told_with_its_place(plugin, field, value):
    path = plugin(f"""
        GOOD = dict(flows=(), buffer_s=float("inf"), batch_bytes=0, batch_compute_s=0.0, sync_bytes=0,
            sync_compute_s=0.0, sync_rate_hz=0.0, lead_s=0.0, measured=False)
        def demand(*_):
            return Demand(**GOOD | {{"{field}": {value}}})
    """)

    message = refusal(path, "demand")

    assert message.startswith(f"{path}:{LAST_LINE + 4}: demand() must ")
    assert ("flow" if field == "flows" else field) in message


def test_check_that_returns_what_cannot_be_shown_is_told_with_its_place(plugin):
    path = plugin("def check(*_):\n    return [10**5000]\n")

    assert refusal(path, "check").endswith("got a list that cannot be shown")


def test_demand_that_is_none_is_told_with_its_place(plugin):
    path = plugin()

    assert refusal(path, "demand") == (
        f"{path}:{LAST_LINE - 1}: demand() must return a madns_runtime.plugin.api.Demand, got None"
    )


def test_neighbour_of_a_plugin_file_can_be_imported_by_it(plugin):
    plugin("FACTOR = 3\n", head="", name="neighbour_of_plugin.py")
    path = plugin("from neighbour_of_plugin import FACTOR\n")
    before = list(sys.path)

    registry.resolve(f"{path}:simulation", path.parent)

    assert sys.path == before
    assert sys.modules[registry.module_name(path)].FACTOR == 3


def test_neighbour_of_a_plugin_file_hides_no_installed_module(plugin):
    plugin("raise RuntimeError('hidden')\n", head="", name="colorsys.py")
    path = plugin("import colorsys\n")

    assert registry.resolve(f"{path}:simulation", path.parent).name == "p"


def test_every_faulty_part_of_a_file_is_told_with_its_line_and_not_with_a_modules_name(plugin):
    path = plugin("""
        class Host:
            def setup(self): pass
        broken = Simulation(name="p", parameters=Parameters, agent=":Agnt", host=":Host", check=":chck")
    """)
    descriptor = registry.resolve(f"{path}:broken", path.parent)

    faults = registry.part_faults(descriptor, path.parent)

    assert [fault.split(": ")[0] for fault in faults] == [
        f"{path}:{LAST_LINE + 4}",
        f"{path}:{LAST_LINE + 2}",
        f"{path}:{LAST_LINE + 4}",
    ]
    assert "there is no 'Agnt', did you mean Agent?" in faults[0]
    assert "no method initial_data()" in faults[1]
    assert code_places.MODULE_PREFIX not in "".join(faults)


@pytest.mark.parametrize(
    ("stream", "told"),
    [
        ("name='../x', fields=(F('x_m', 'm'),)", "'../x': expected a name of letters"),
        ("name='host_x', fields=(F('x_m', 'm'),)", "cannot begin with host_ or machine_"),
        (r"name='x', fields=(F('\ud800'),)", "expected a field's name to be a text"),
        ("name='x', fields=(F('incarnation'),)", "none of incarnation, which tables add"),
        ("name='x', fields=(F('x_m', None),)", "expected the unit of x_m to be a text"),
        ("name='x', fields=(F('x_m', 'm', ['float']),)", "must give 'x' fields of kind float"),
        ("name='x', fields=(F('x_m', digits='3'),)", "expected digits, 0 to 15"),
        ("name='x', fields=(F('x_m'), F('x_m'))", "expected fields with distinct names"),
        ("name='x', fields=(F('x_m'),), is_open='no'", "DeclaredStream.is_open: expected bool"),
        (
            "name='x', fields=(F('t_s', 'ms'),)",
            "stream x: t_s is simulated time in seconds, got unit 'ms'",
        ),
    ],
)
def test_a_declared_stream_that_could_not_be_opened_is_told_before_the_run(plugin, stream, told):
    path = plugin(f"""
from madns_runtime.plugin.api import DeclaredStream as D, Field as F
def streams(parameters, agents):
    return [D(role='agent', {stream})]
""")

    with pytest.raises(PluginError, match=re.escape(told)):
        ask_streams(f"{path}:streams", path.parent, parameters=None, agents=("a",))


@pytest.mark.parametrize(
    ("label", "told"),
    [
        (r"'\ud800'", "must call a by a text of at most 200 printable characters"),
        (r"'x\n'", "must call a by a text of at most 200 printable characters"),
        ("'x' * 201", "must call a by a text of at most 200 printable characters"),
        ("'b'", "calls a b, which is another agent's name"),
        ("'host'", "calls a host, which means the host wherever an agent is named"),
        ("'*'", "calls a *, which means all agents wherever an agent is named"),
    ],
)
def test_labels_that_no_file_holds_or_that_are_names_of_others_are_told(plugin, label, told):
    path = plugin(f"def labels(parameters, agents, base):\n    return {{'a': {label}}}\n")

    with pytest.raises(PluginError, match=re.escape(told)):
        ask_labels(f"{path}:labels", path.parent, parameters=None, agents=("a", "b"))


@pytest.mark.parametrize(
    ("use", "told"),
    [
        ("agent=['a'], field='f', device='d', channel='c'", "by agents of the scenario"),
        ("agent='a', field=5, device='d', channel='c'", "DeviceUse.field: expected str, got 5"),
        ("agent='a', field='f', device='d', channel='c', direction='up'", "DeviceUse.direction"),
        (r"agent='a', field='f', device='\ud800', channel='c'", "printable characters, got device"),
    ],
)
def test_a_use_of_other_kinds_is_told_with_its_field(plugin, use, told):
    path = plugin(f"""
from madns_runtime.plugin.api import DeviceUse
def uses(parameters, agents, base):
    return [DeviceUse({use})]
""")

    with pytest.raises(PluginError, match=re.escape(told)):
        ask_device_uses(f"{path}:uses", path.parent, parameters=None, agents=("a",))


def test_an_answer_that_raises_when_it_is_looked_at_is_the_plugins_fault(plugin):
    path = plugin("""
class Odd(dict):
    def items(self):
        raise RuntimeError("no items")
def labels(parameters, agents, base):
    return Odd(a="x")
""")

    with pytest.raises(PluginError, match=r"plugin.py:\d+: labels\(\): RuntimeError: no items"):
        ask_labels(f"{path}:labels", path.parent, parameters=None, agents=("a",))


@pytest.mark.parametrize("raised", ["GeneratorExit", "KeyboardInterrupt"])
def test_whatever_a_question_raises_is_told_where_nobody_can_have_pressed_ctrl_c(
    plugin, monkeypatch, raised
):
    monkeypatch.setattr("signal.getsignal", lambda number: signal.SIG_DFL)
    path = plugin(f"def check(*_):\n    raise {raised}\n")

    assert re.search(rf"plugin.py:\d+: check\(\): {raised}$", refusal(path, "check"))


def test_ctrl_c_during_a_question_is_no_fault_of_the_plugin(plugin, monkeypatch):
    monkeypatch.setattr("signal.getsignal", lambda number: signal.default_int_handler)
    path = plugin("def check(*_):\n    raise KeyboardInterrupt\n")

    with pytest.raises(KeyboardInterrupt):
        ask(path, "check")


def test_answers_without_end_are_told_before_they_fill_the_memory(plugin, monkeypatch):
    monkeypatch.setattr(isolation, "ITEMS_MAX", 1000)
    path = plugin(
        """
        yielded = []
        def streams(parameters, agents):
            while True:
                yielded.append(1)
                yield None
        """
    )

    with pytest.raises(
        PluginError, match=r"plugin.py:\d+: streams\(\): ValueError: it gave more than 1000"
    ):
        ask_streams(f"{path}:streams", path.parent, parameters=None, agents=("a",))

    module = registry.load_object(f"{path}:streams", path.parent)[0]
    assert len(module.yielded) == 1001
