"""Settings: an unknown name and an invalid value are refused, wherever they come from."""

import copy
import pickle

import numpy as np
import pytest

from catstream.base.settings import PRESETS, CoresetSettings, RunSettings, Settings
from catstream.errors import SettingsError


@pytest.mark.parametrize("text", [b"\xff", b"coreset_size", b"x = " + b"[" * 100_000], ids=["bytes", "text", "nested"])
def test_file_that_is_not_toml_is_an_error_that_names_it(text, tmp_path):
    (tmp_path / "set.toml").write_bytes(text)
    with pytest.raises(SettingsError, match=r"set\.toml: this is not TOML"):
        Settings.load(file=tmp_path / "set.toml", environment={})


#: Each way in which a program or a user sets a value.
WAYS = {
    "values": lambda name, value: Settings.from_values({name: value}),
    "replace": lambda name, value: Settings().replace({name: value}),
    "set": lambda name, value: Settings.load(overrides=[f"{name}={value}"], environment={}),
    "environment": lambda name, value: Settings.load(
        environment={f"CATSTREAM_{name.upper().replace('.', '_')}": str(value)}
    ),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("name", "value", "takes"),
    [
        ("coreset.size", "x", "int >= 2, <= 4096"),
        ("coreset.size", 2.5, "int >= 2, <= 4096"),
        ("extent.size_count", 4, "1 | 3 | 5 | 7 | 9 | 11 | 13 | 15"),
        ("run.image_rate", 5e-324, "float >= 1e-09, <= 1000"),
        ("run.checkpoint_seconds", 0, "float > 0, <= 3600"),
        ("run.checkpoint_seconds", float("nan"), "float > 0, <= 3600"),
        ("belief.trusted_score", float("inf"), "float"),
        ("run.lockstep", 7, "bool"),
        ("training.classifier", "\udcff", "joint | least-squares | one-class"),
    ],
)
def test_invalid_value_is_an_error_with_the_accepted_values(way, name, value, takes):
    with pytest.raises(SettingsError) as error:
        WAYS[way](name, value)
    messages = [f"setting {name} cannot be {shown!r}: expected {takes}" for shown in (value, str(value))]
    assert str(error.value) in messages


@pytest.mark.parametrize("way", WAYS)
def test_unknown_name_is_an_error_with_the_nearest_one(way):
    with pytest.raises(SettingsError) as error:
        WAYS[way]("coreset.sice", 64)
    variable = " for the environment variable CATSTREAM_CORESET_SICE" if way == "environment" else ""
    assert str(error.value).startswith(f"there is no setting 'coreset.sice'{variable}, did you mean 'coreset.size'")


@pytest.mark.parametrize(
    "variable",
    ["HOME", "LOG_LEVEL", "SERVICE_HOST", "PORT", "PORT_5700_TCP_ADDR", "RUN_SERVICE_PORT_WEB", "RUN_PORT_5700_TCP"],
)
def test_variable_of_another_program_is_ignored(variable):
    assert Settings.load(environment={f"CATSTREAM_{variable}": "x"}) == Settings()


def test_empty_variable_of_a_setting_is_an_error():
    with pytest.raises(SettingsError, match="CATSTREAM_RUN_ENDPOINT is empty"):
        Settings.load(environment={"CATSTREAM_RUN_ENDPOINT": ""})


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("coreset_size", "there is no setting 'coreset_size', did you mean 'coreset.size'"),
        ("keys", "there is no setting 'keys', did you mean 'run.keys'"),
        ("qqq", r"there is no setting 'qqq': `catstream settings` lists all \d+$"),
    ],
)
def test_setting_without_its_group_is_an_error(name, why):
    with pytest.raises(SettingsError, match=why):
        Settings(**{name: 1})


def test_numpy_numbers_are_stored_as_python_numbers():
    settings = Settings(coreset={"size": np.int64(32)}, search={"area": np.float32(2.5)}, run={"image_rate": 30})
    assert Settings(run={"lockstep": np.True_}).run.lockstep is True
    numbers = settings.coreset.size, settings.search.area, settings.run.image_rate
    assert [type(number) for number in numbers] == [int, float, float]
    assert settings == Settings(coreset={"size": 32}, search={"area": 2.5}, run={"image_rate": 30.0})


def test_flat_and_nested_groups_give_the_same_settings():
    flat, nested = {"coreset.size": 32, "run.seed": 7}, {"coreset": {"size": 32}, "run": {"seed": 7}}
    groups = Settings(coreset=CoresetSettings(size=32), run=RunSettings(seed=7))
    assert Settings.from_values(flat) == Settings.from_values(nested) == groups
    assert Settings().replace(nested) == Settings(**nested) == groups


@pytest.mark.parametrize(
    ("pair", "name", "value"),
    [
        ("search.area=.25e1", "search.area", 2.5),
        ("run.seed=007", "run.seed", 7),
        ("run.lockstep=True", "run.lockstep", True),
        ("run.lockstep=0", "run.lockstep", False),
        ("search.mode = full", "search.mode", "full"),
    ],
)
def test_text_is_converted_to_the_type_of_its_setting(pair, name, value):
    assert Settings.load(overrides=[pair], environment={}).values()[name] == value


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_settings_survive_texts_copies_and_pickles(preset):
    settings = Settings.load(preset=preset, environment={})
    assert Settings.load(overrides=settings.changed(), environment={}) == settings
    assert copy.deepcopy(settings) == pickle.loads(pickle.dumps(settings)) == settings
