"""Commands of a fleet, with a stand-in for it."""

import os
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from catstream.cli.fleet_commands import _down
from catstream.fleet import fleet


def test_fleet_that_loses_a_state_at_its_end_is_an_error(capsys):
    _down(SimpleNamespace(name="site", down=list))
    with pytest.raises(SystemExit) as ended:
        _down(SimpleNamespace(name="site", down=lambda: ["gate: the store is full"]))
    assert ended.value.code == 1
    out, err = capsys.readouterr()
    assert out == 2 * "the fleet site is down\n"
    assert "gate: the store is full" in err


@pytest.mark.parametrize("command", ["up", "down"])
def test_fleet_without_a_home_directory_is_an_error(command, fail, tmp_path, monkeypatch):
    file = tmp_path / "fleet.toml"
    file.write_text('[streams.one]\nsource = "demo:1"\n')
    for name in ("HOME", "XDG_STATE_HOME", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 54321)  # no line in /etc/passwd
    assert "set HOME or XDG_STATE_HOME" in fail("fleet", command, *([file] if command == "up" else []))


def test_added_stream_has_the_options_of_the_command(succeed, tmp_path, monkeypatch):
    added = []
    site = SimpleNamespace(add=lambda spec: [added.append(spec)] and ["gate: is added"])
    monkeypatch.setattr(fleet, "Fleet", lambda *_, **__: nullcontext(site))
    monkeypatch.chdir(tmp_path)
    words = ["--box", "anna=1,2,30,40", "--set", "coreset.size=32", "--write", "{stream}.ndjson"]
    assert succeed("fleet", "add", "gate", "demo:1", *words)[0] == "gate: is added\n"
    assert (added[0].source, added[0].settings) == ("demo:1", {"coreset.size": "32"})
    assert (list(added[0].boxes), added[0].write) == (["anna"], (str(tmp_path / "gate.ndjson"),))
