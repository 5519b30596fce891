"""The help of the command line teaches: an example a command, every field of the config, every command."""

from __future__ import annotations

import pytest

from rsgen.cli.main import main
from rsgen.config.config import describe_fields

COMMANDS = ("scenes", "import", "render", "info", "verify", "preview", "export", "pack")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main([command, "--help"])
    out, error = capfd.readouterr()
    assert exit.value.code == 0 and error == ""
    assert f"example: rsgen {command}" in out


@pytest.mark.parametrize("command", ["render", "pack"])
def test_help_lists_every_field_of_the_config(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = " ".join(capfd.readouterr().out.split())
    fields = describe_fields()
    assert len(fields) > 35
    for name, _, description in fields:
        assert f"--{name} VALUE" in text
        assert "".join(description.split()) in "".join(text.split())


def test_the_main_help_lists_every_command(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main(["--help"])
    text = capfd.readouterr().out
    assert exit.value.code == 0 and all(f"    {command} " in text for command in (*COMMANDS, "motion"))
    assert "rsgen render demo" in text
