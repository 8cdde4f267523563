"""Requirements that are taken are those that `cosmos up` can read: packaging's are the authority."""

import pytest
from packaging.requirements import InvalidRequirement
from packaging.requirements import Requirement as PackagingRequirement
from pydantic import TypeAdapter, ValidationError

from cosmos_cli.models.text_forms import Requirement, ScenarioRequirement

TAKEN = (
    "numpy",
    "pyserial[cp2110] >= 3.5, <4",
    "a==1.*; python_version >= '3.12' and (os_name == \"posix\" or sys.platform != 'win32')",
    "a==1!2.0rc1.post2.dev3+deb.12; platform_machine in 'aarch64 armv7l'",
    "a~=V1.0-ALPHA; 'arm' not in platform_machine",
    "a===anything; extra == 'x'",
    "a @ file:///a.whl ; os_name == 'posix'",
    "a; ((os_name == ')') and (sys.platform != \"(\"))",
)
REFUSED = (
    "x;y",
    "x;",
    "x; python_versoin > '3'",
    "x; python_version = '3'",
    "x; python_version > '3' os_name == 'posix'",
    "x; python_version > 3",
    "x>=1.*",
    "x==foo",
    "x~=1",
    "x>=1.0+local",
    "x===1.0)",
    "x\n>=1",
    "x; os_name == 'a'\nand os_name == 'b'",
    "x; (python_version > '3'",
    "x; python_version > '3')",
    "x; os_name == 'a') or (os_name == 'b'",
    "x @ file:///a.whl ; (os_name == ')'",
)


@pytest.mark.parametrize("text", TAKEN)
def test_requirement_that_pip_reads_is_taken(text):
    PackagingRequirement(text)

    assert TypeAdapter(Requirement).validate_python(text) == text
    assert TypeAdapter(ScenarioRequirement).validate_python(text) == text


@pytest.mark.parametrize("text", REFUSED)
def test_requirement_that_pip_does_not_read_is_refused(text):
    with pytest.raises(InvalidRequirement):
        PackagingRequirement(text)

    for kind in (Requirement, ScenarioRequirement):
        with pytest.raises(ValidationError, match="expected a Python requirement such as"):
            TypeAdapter(kind).validate_python(text)
