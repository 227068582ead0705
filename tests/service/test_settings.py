import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from gpom_core.errors import ConfigurationError
from service.settings import Settings
from service.settings_file import annotated_yaml, load_settings


@pytest.fixture(autouse=True)
def _no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith("GPOM_"):
            monkeypatch.delenv(name)


def _file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "gpom.yaml"
    path.write_text(text)
    return path


def test_defaults_need_no_source() -> None:
    assert load_settings() == Settings()
    assert load_settings().http.host == "127.0.0.1"


def test_each_source_wins_over_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _file(tmp_path, "http: {port: 1, host: a, query_threads: 7}\nlog_level: error\n")
    monkeypatch.setenv("GPOM_HTTP__PORT", "2")
    monkeypatch.setenv("GPOM_HTTP__HOST", "b")
    monkeypatch.setenv("GPOM_ZENOH__CONNECT", '["tcp/127.0.0.1:7448"]')
    settings = load_settings(path, {"http": {"port": 3}})
    assert (settings.http.port, settings.http.host, settings.http.query_threads) == (3, "b", 7)
    assert settings.log_level == "error"
    assert settings.zenoh.connect == ("tcp/127.0.0.1:7448",)


def test_map_is_set_like_everything_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPOM_MAP__LENGTH_SCALE_M", "0.3")
    assert load_settings().map.length_scale_m == 0.3


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("http: {prot: 1}", "http.prot: unknown"),
        ("htpp: {port: 1}", "htpp: unknown"),
        ("http: {port: 99999}", "http.port"),
        ("map: {length_scale_m: -1}", "map.length_scale_m"),
        ("zenoh: {prefix: 'a/*/b'}", "zenoh.prefix"),
        ("zenoh: {prefix: '/a'}", "zenoh.prefix"),
        ("zenoh: {robots: ['*']}", "zenoh.robots"),
        ("zenoh: {robots: ['a/b']}", "zenoh.robots"),
        ("data_dir: ''", "data_dir"),
        ("journal: {checkpoint_interval_s: .inf}", "journal.checkpoint_interval_s"),
        ("training: {workers: 100000000}", "training.workers"),
        ("training: {job_timeout_s: 1.0e+300}", "training.job_timeout_s"),
        ("- 1", "no table"),
        ("a: [", "not YAML"),
    ],
)
def test_bad_files_are_refused_with_the_name(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(ConfigurationError, match=expected):
        load_settings(_file(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    [
        "access: {read_tokens: hunter2}",
        "access: {read_tokens: [hunter2, 5]}",
        "access: {read_tokens: {a: hunter2hunter2hunter2}}",
        "access: hunter2",
        "zenoh: {password: [hunter2]}",
        "zenoh: {options: [hunter2]}",
        "token: hunter2: : x",
        "token: 'hunter2",
    ],
)
def test_what_is_wrong_is_told_without_secrets_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_settings(_file(tmp_path, text))
    assert "hunter2" not in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("http: {port: 1}\nlog_level: info\nhttp: {host: a}\n", "'http' twice, in lines 1 and 3"),
        (
            "access:\n  read_tokens: [hunter2hunter2hunter2]\n  read_tokens: []\n",
            "'access.read_tokens' twice, in lines 2 and 3",
        ),
        ("http: {port: 1, 'port': 2}\n", "'http.port' twice, in lines 1 and 1"),
        (
            "zenoh:\n  options:\n    a: [1, {b: hunter2, c: 2,\n      b: 3}]\n",
            "'zenoh.options.a.b' twice, in lines 3 and 4",
        ),
        ("zenoh: {options: {a: &a {b: *a, c: 1, c: 1}}}\n", "'zenoh.options.a.c' twice"),
    ],
)
def test_a_name_may_be_there_once_only(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(expected)) as caught:
        load_settings(_file(tmp_path, text))
    assert str(tmp_path / "gpom.yaml") in str(caught.value)
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize(
    ("variable", "value", "name"),
    [
        ("GPOM_HTTP", '{"port": 1, "host": "hunter2", "port": 2}', "port"),
        ("GPOM_ZENOH__OPTIONS", '{"a": [{"b": "hunter2", "b": 1}]}', "b"),
        ("gpom_map", '{"cell_m": 0.1, "cell_m": 0.2}', "cell_m"),
    ],
)
def test_a_name_may_be_in_a_variable_once_only(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, name: str
) -> None:
    monkeypatch.setenv(variable, value)
    expected = f"environment variable {variable} has '{name}' twice"
    with pytest.raises(ConfigurationError, match=expected) as caught:
        load_settings()
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        ("2026-13-45", "timestamp"),
        ("2026-01-01T99:00:00", "timestamp"),
        ("!!timestamp hunter2", "timestamp"),
        ("!!int hunter2", "int"),
        ("!!float hunter2", "float"),
        ("!!bool hunter2", "bool"),
    ],
)
def test_a_value_that_is_not_what_it_looks_like_is_named(
    tmp_path: Path, value: str, kind: str
) -> None:
    path = _file(tmp_path, f"log_level: info\ndata_dir: {value}\n")
    expected = f"{path} is not YAML: what looks like a {kind} is none in line 2, column 11"
    with pytest.raises(ConfigurationError, match=re.escape(expected)) as caught:
        load_settings(path)
    assert "hunter2" not in str(caught.value)


def test_what_is_written_once_and_meant_twice_is_no_mistake(tmp_path: Path) -> None:
    text = "http: &ours {port: 5, host: a}\nzenoh: {options: {x: &y {z: 1}, w: *y}}\n"
    assert load_settings(_file(tmp_path, text)).zenoh.options == {"x": {"z": 1}, "w": {"z": 1}}
    text = "zenoh: {options: {x: &x {a: 1, b: 1}, y: {<<: *x, a: 2}}}\n"
    assert load_settings(_file(tmp_path, text)).zenoh.options["y"] == {"a": 2, "b": 1}


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nowhere\.yaml: No such file"):
        load_settings(tmp_path / "nowhere.yaml")


def test_empty_file_changes_nothing(tmp_path: Path) -> None:
    assert load_settings(_file(tmp_path, "# nothing\n")) == Settings()


@pytest.mark.parametrize("name", ["GPOM_PORT", "GPOM_HTPP__PORT", "GPOM_HTTP__PROT"])
def test_unknown_variables_are_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "1")
    with pytest.raises(ConfigurationError, match=r"(?i)unknown|no setting"):
        load_settings()


@pytest.mark.parametrize(
    ("text", "expected"),
    [("a", ("a",)), ("a, b", ("a", "b")), ('["a", "b"]', ("a", "b")), ("", ()), ("[]", ())],
)
def test_endpoints_in_the_environment(
    monkeypatch: pytest.MonkeyPatch, text: str, expected: tuple[str, ...]
) -> None:
    monkeypatch.setenv("GPOM_ZENOH__LISTEN", text)
    assert load_settings().zenoh.listen == expected


@pytest.mark.parametrize("name", ["GPOM_ZENOH__OPTIONS", "GPOM_HTTP"])
def test_variable_that_is_no_json(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "{")
    with pytest.raises(ConfigurationError, match="JSON"):
        load_settings()


def test_printed_settings_read_back_the_same(tmp_path: Path) -> None:
    settings = load_settings(flags={"http": {"port": 1234}, "data_dir": str(tmp_path)})
    text = annotated_yaml(settings)
    assert load_settings(_file(tmp_path, text)) == settings
    assert text.count("#") > 20


def test_every_setting_is_printed() -> None:
    printed = yaml.safe_load(annotated_yaml(Settings()))
    assert printed == Settings().model_dump(mode="json")


def test_command_prints_a_valid_file() -> None:
    code = "from service.cli import serve; import typer; typer.run(serve)"
    done = subprocess.run(
        [sys.executable, "-c", code, "--print-config", "--port", "4321"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert yaml.safe_load(done.stdout)["http"]["port"] == 4321
