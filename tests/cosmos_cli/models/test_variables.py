"""${name} in a scenario: what it becomes, what a plug-in keeps for itself, and what is refused where."""

import pytest
import yaml

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import check_scenario, load_scenario
from cosmos_cli.models.variables import REFERENCES_MAX

HEAD = "name: a\nsimulation: counter\nagents: {count: 3}\n"
FLIGHT = """\
name: a
simulation: constellation
agents: {count: 1}
vars: {program: sh, speed: 9600}
parameters:
  satellites: {walker: "56:1/1/0", altitude_km: 780}
  epoch_utc: "2026-01-01T00:00:00Z"
  propagator: {kind: scipy, forces: [two_body]}
  flight:
    - command: ["${program}", "-c", "exit ${index} $${HOME} ${speed}"]
      environment: {VEHICLE: "${satellite} at ${speed}"}
"""


def load(folder, text, *overrides):
    path = folder / "a.yaml"
    path.write_text(text)
    return load_scenario(path, overrides)


def refusal(folder, text, *overrides):
    with pytest.raises(InputError) as caught:
        load(folder, text, *overrides)
    return str(caught.value).replace(f"{folder}/", "")


def test_a_value_that_is_only_a_variable_keeps_its_type(tmp_path):
    found = load(
        tmp_path,
        HEAD + "vars: {bytes: 12, answers: true, rate: 2.5}\nparameters:\n"
        "  payload_bytes: ${bytes}\n  read_on_tick: ${answers}\n  answer_hz: ${rate}\n",
    )

    assert found.parameters["payload_bytes"] == 12
    assert found.parameters["read_on_tick"] is True
    assert found.parameters["answer_hz"] == 2.5


def test_in_a_longer_text_a_variable_stands_as_it_is_written(tmp_path):
    found = load(
        tmp_path,
        HEAD
        + "vars: {x: 0.50, on: true, who: '${x} of ${on}'}\ndescription: a ${who}, $${x} $ {x} $${who\n",
    )

    assert found.scenario.description == "a 0.50 of true, ${x} $ {x} ${who"


@pytest.mark.parametrize(
    ("variables", "overrides"),
    [
        ("tag: 007, r: 1e3", ()),
        ("tag: 1, r: 2", ("vars.tag=007", "vars.r=1e3  # as in a file")),
        ("own: 007, tag: '${own}', r: 1e3", ()),
        ("own: 1, tag: '${own}', r: 2", ("vars.own=007", "vars.r=1e3")),
    ],
)
def test_a_number_stands_as_it_is_written_wherever_that_is(tmp_path, variables, overrides):
    text = f"{HEAD}vars: {{{variables}}}\ndescription: run ${{tag}} at ${{r}}\n"

    assert load(tmp_path, text, *overrides).scenario.description == "run 007 at 1e3"


def test_set_gives_a_variable_another_value_before_it_is_used(tmp_path):
    text = HEAD + "vars: {rate: 2, twice: 'at ${rate}'}\ndescription: ${twice}\nseed: ${rate}\n"

    found = load(tmp_path, text, "vars.rate=5")

    assert (found.scenario.description, found.scenario.seed) == ("at 5", 5)


def test_what_set_gives_may_name_variables(tmp_path):
    assert load(tmp_path, HEAD + "vars: {rate: 2}\n", "seed=${rate}").scenario.seed == 2


def test_variables_come_from_bases_and_are_used_by_them(tmp_path):
    (tmp_path / "base.yaml").write_text(HEAD + "vars: {rate: 2, other: 1}\nseed: ${rate}\n")

    assert load(tmp_path, "extends: base.yaml\nvars: {rate: 7}\n").scenario.seed == 7


def test_words_that_flight_software_is_given_per_agent_stay(tmp_path):
    found = load(tmp_path, FLIGHT)

    (rule,) = found.parameters["flight"]
    assert list(rule["command"]) == ["sh", "-c", "exit ${index} $${HOME} 9600"]
    assert rule["environment"] == {"VEHICLE": "${satellite} at 9600"}


def test_a_variable_cannot_have_the_name_of_such_a_word(tmp_path):
    told = refusal(tmp_path, FLIGHT.replace("speed: 9600", "speed: 9600, satellite: x"))

    assert "a.yaml:4:34: vars.satellite: ${satellite} is a word of the simulation's own" in told


def test_an_unknown_word_of_flight_software_is_told_once_with_what_was_meant(tmp_path):
    told = refusal(tmp_path, FLIGHT.replace("${satellite}", "${satelite}"))

    assert "a.yaml:11:30: parameters.flight[0].environment.VEHICLE: " in told
    assert "no variable is named satelite, did you mean satellite?" in told
    assert told.count("satelite") == 2  # the fault, and its line


def test_such_a_word_elsewhere_is_a_fault(tmp_path):
    assert "no variable is named satellite" in refusal(
        tmp_path, FLIGHT.replace("kind: scipy", 'kind: "${satellite}"')
    )


def test_what_is_put_into_such_a_text_is_no_word_of_it(tmp_path):
    found = load(tmp_path, FLIGHT.replace("program: sh", "program: 'sh$${name}'"))

    assert found.parameters["flight"][0]["command"][0] == "sh$${name}"


def test_a_literal_elsewhere_in_parameters_is_itself(tmp_path):
    found = load(tmp_path, HEAD + "parameters: {send_device: 'a$${b'}\n")

    assert found.parameters["send_device"] == "a${b"


def test_devices_keep_the_name_of_whoever_drives_them(tmp_path):
    device = "hardware:\n  devices: [{name: gps, kind: gnss_receiver, rate_hz: 10, parameters: {link: 'x/WORD'}}]\n"
    text = HEAD + "vars: {line: 3}\n" + device

    found = load(tmp_path, text.replace("WORD", "${line}-${name}"))

    assert found.scenario.hardware.devices[0].parameters["link"] == "x/3-${name}"
    assert "no variable is named nam, did you mean name?" in refusal(
        tmp_path, text.replace("WORD", "${nam}")
    )


def test_fault_of_a_value_tells_which_variable_it_is_of(tmp_path):
    assert "a.yaml:5:7: seed: expected >= 0, got -4 (${seed} of a.yaml:4)" in refusal(
        tmp_path, HEAD + "vars: {seed: -4}\nseed: ${seed}\n"
    )


def test_fault_of_a_value_tells_where_its_variable_has_its_own(tmp_path):
    (tmp_path / "b.yaml").write_text(
        "simulation: counter\nvars: {n: 3}\nagents: {count: '${n}'}\ntime: {duration_s: 1}\n"
    )
    text = "extends: b.yaml\nname: a\nvars:\n  n: many\n"

    told = "b.yaml:3:17: agents.count: expected a whole number, got 'many' (${n} of a.yaml:4)"
    assert refusal(tmp_path, text).startswith(told)
    assert "got 0 (${n} of --set vars.n)" in refusal(tmp_path, text, "vars.n=0")


def test_a_scenario_made_of_final_values_knows_no_variables(tmp_path):
    found = check_scenario(HEAD + "description: ${x} $${y}\n", tmp_path / "a.yaml")

    assert found.scenario.description == "${x} $${y}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("description: ${x}\n", "a.yaml:4:14: description: no variable is named x; vars names none; $${ stands for ${ itself"),
        ("vars: {rate: 1}\nseed: ${rat}\n", "a.yaml:5:7: seed: no variable is named rat, did you mean rate?"),
        ("vars: {a: 1}\ndescription: x ${a\n", "a.yaml:5:14: description: expected ${name}, got ${a without its closing }"),
        ("vars: {a: 1}\ndescription: x ${a b}\n", "a.yaml:5:14: description: expected ${name}, got ${a b}"),
        ("vars: {a: 1}\ndescription: ${}\n", "a.yaml:5:14: description: expected ${name}, got ${}"),
        ("vars: {a: '${b}', b: '${a}'}\n", "a.yaml:4:11: vars.a: expected a value that does not need itself, got ${a} -> ${b} -> ${a}"),
        ("vars: {a: 'x${a}'}\n", "a.yaml:4:11: vars.a: expected a value that does not need itself, got ${a} -> ${a}"),
        ("vars: {a: '${c}'}\n", "a.yaml:4:11: vars.a: no variable is named c; known here: a"),
        ("vars: {a: [1]}\n", "a.yaml:4:11: vars.a: expected a text, a number, true or false, got a list"),
        ("vars: {a: }\nseed: ${a}\n", "a.yaml:4:11: vars.a: expected a value, here or with --set vars.a=VALUE, got nothing"),
        ("vars: {a-b: 1}\n", "a.yaml:4:8: vars.a-b: expected letters, digits and _ as a variable's name, got 'a-b'"),
        ("vars: {name: 1}\n", "a.yaml:4:8: vars.name: ${name} stands for the agent's name"),
        ("vars: [1]\n", "a.yaml:4:7: vars: expected a mapping, got a list"),
        ("vars: {a: 1}\nparameters: {'${a}': 1}\n", "a.yaml:5:14: parameters.${a}: expected a key as it is, got '${a}'"),
        ("vars: {a: 1}\nparameters: {payload_bytes: '${b}'}\n", "a.yaml:5:29: parameters.payload_bytes: no variable is named b"),
        ("vars: {a: 1}\nagents: {count: ${a}}\n", "a.yaml:3:17: a brace within braces or brackets: put ${...} in quotes"),
    ],
)  # fmt: skip
def test_what_stands_for_nothing_is_refused_with_its_place(tmp_path, text, expected):
    told = refusal(tmp_path, (HEAD if "agents" not in text else "name: a\n") + text)

    assert expected in told
    assert told.count("a.yaml:") == 1  # and nothing that only follows from it


def test_a_variable_of_set_that_no_file_names_is_a_fault(tmp_path):
    told = refusal(tmp_path, HEAD + "vars: {rate: 2}\n", "vars.rat=3")

    assert told == "--set vars.rat: no variable is named rat, did you mean rate?"


def test_variables_that_double_each_other_have_a_bound(tmp_path):
    doubling = [f"  v{n}: '${{v{n - 1}}}${{v{n - 1}}}'\n" for n in range(1, 15)]

    told = refusal(tmp_path, HEAD + "vars:\n  v0: abcd\n" + "".join(doubling))

    assert "expected at most 20000 characters with its variables" in told


def test_a_long_chain_of_variables_has_a_bound(tmp_path):
    chain = [f"  v{n}: '${{v{n + 1}}}'\n" for n in range(40)]

    told = refusal(tmp_path, HEAD + "vars:\n" + "".join(chain) + "  v40: 1\n")

    assert f"expected at most {REFERENCES_MAX} variables that are made of each other" in told


def test_what_results_is_written_so_that_it_means_the_same_when_it_is_read(tmp_path):
    first = load(tmp_path, FLIGHT + "description: $${speed} of ${speed}\n")

    again = load(tmp_path, yaml.safe_dump(first.to_written()))

    assert again.to_mapping() == first.to_mapping()
    assert again.scenario.description == "${speed} of 9600"
