"""Settings from four places, each stronger than the one before: defaults, file, environment, flags.

The environment speaks as ``GPOM_LOG_LEVEL=debug``, ``GPOM_HTTP__PORT=80`` or
``GPOM_ZENOH__CONNECT=tcp/10.0.0.1:7447,tcp/10.0.0.2:7447``; tables are JSON.
"""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_settings import (
    BaseSettings,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from gpom_core.errors import ConfigurationError
from service.settings import Settings

ENV_PREFIX = "GPOM_"
_FOREIGN_VARIABLES = frozenset({"GPOM_DATA"})  # where tests find recorded data; not a setting


def load_settings(
    config: Path | None = None,
    flags: Mapping[str, Any] | None = None,
) -> Settings:
    """Merge all sources and validate the result.

    Args:
        config: YAML file with any part of the settings.
        flags: nested values, as in the file, that win over everything else.

    Raises:
        ConfigurationError: unreadable file, unknown key or value out of range, all of them named.
    """
    from_file = {} if config is None else _read(config)
    _refuse_unknown_variables()
    _refuse_twins_in_variables()

    class Sources(BaseSettings, Settings):
        model_config = SettingsConfigDict(
            env_prefix=ENV_PREFIX, env_nested_delimiter="__", extra="forbid"
        )

        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - not a source here
            file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - neither is this
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return init_settings, env_settings, InitSettingsSource(settings_cls, from_file)

    try:
        merged = Sources(**(flags or {}))
    except ValidationError as error:
        raise ConfigurationError(_explain(error, config)) from error
    except SettingsError as error:
        raise ConfigurationError(f"{error}; tables are JSON there") from error
    return Settings(**{name: getattr(merged, name) for name in Settings.model_fields})


def annotated_yaml(settings: Settings) -> str:
    """Give the settings as a YAML file that `load_settings` reads, each with what it means."""
    lines = [
        "# Settings of gpom serve: defaults < this file < environment GPOM_* < flags.",
        f"# In the environment: {ENV_PREFIX}HTTP__PORT=8081, {ENV_PREFIX}LOG_LEVEL=debug, …",
        *_section(settings, indent=0),
    ]
    return "\n".join(lines) + "\n"


def _read(path: Path) -> dict[str, Any]:
    try:
        content = _load(path)
    except OSError as error:
        message = f"cannot read the settings file {path}: {error.strerror or error}"
        raise ConfigurationError(message) from error
    except yaml.MarkedYAMLError as error:
        # Not all that it says: it quotes the line, which may hold a token.
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f" in line {mark.line + 1}, column {mark.column + 1}"
        raise ConfigurationError(f"{path} is not YAML: {error.problem}{where}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        message = f"{path} is not YAML: it holds what is no text"
        raise ConfigurationError(message) from error
    if content is None:
        return {}
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ConfigurationError(f"{path} holds no table of settings; expected lines `name: value`")
    return content


class _Loader(yaml.SafeLoader):
    """PyYAML's, which leaves a date of month 13 to the error of whoever makes dates."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError) as error:
            problem = f"what looks like a {node.tag.rpartition(':')[2]} is none"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark) from error


def _load(path: Path) -> Any:
    loader = _Loader(path.read_text(encoding="utf-8"))
    try:
        root = loader.get_single_node()
        if root is None:
            return None
        _refuse_twins(root, path)
        return loader.construct_document(root)
    finally:
        loader.dispose()


def _refuse_twins(root: yaml.Node, path: Path) -> None:
    """Refuse two entries of one name: YAML would forget the first, silently."""
    seen: set[int] = set()  # an alias is the node itself, and may be within it
    nodes: list[tuple[yaml.Node, tuple[str, ...]]] = [(root, ())]
    while nodes:
        node, place = nodes.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            nodes += [(item, place) for item in node.value]
        if isinstance(node, yaml.MappingNode):
            lines: dict[tuple[str, str], int] = {}
            for key, value in node.value:
                if not isinstance(key, yaml.ScalarNode):
                    continue  # a list or a table is refused as a name, later
                inside, line = (*place, key.value), key.start_mark.line + 1
                if (first := lines.get((key.tag, key.value))) is not None:
                    message = (
                        f"{path} has {'.'.join(inside)!r} twice, in lines {first} and {line}: "
                        "make one of them"
                    )
                    raise ConfigurationError(message)
                lines[key.tag, key.value] = line
                nodes.append((value, inside))


def _refuse_twins_in_variables() -> None:
    """Refuse the same in JSON, which would forget the first as well."""
    for variable, value in os.environ.items():
        if not variable.upper().startswith(ENV_PREFIX):
            continue

        def once(pairs: list[tuple[str, Any]], variable: str = variable) -> dict[str, Any]:
            table = dict(pairs)
            if len(table) < len(pairs):
                names = [name for name, _ in pairs]
                twin = next(name for name in names if names.count(name) > 1)
                message = (
                    f"the environment variable {variable} has {twin!r} twice: make one of them"
                )
                raise ConfigurationError(message)
            return table

        with suppress(ValueError):  # text, or refused where it should be JSON
            json.loads(value, object_pairs_hook=once)


def _refuse_unknown_variables() -> None:
    known = {name.upper() for name in Settings.model_fields}
    unknown = sorted(
        variable
        for variable in os.environ
        if variable.upper().startswith(ENV_PREFIX)
        and variable.upper() not in _FOREIGN_VARIABLES
        and variable.upper().removeprefix(ENV_PREFIX).split("__")[0] not in known
    )
    if unknown:
        message = (
            f"no setting has the name of the environment variable {', '.join(unknown)}; expected "
            f"{', '.join(ENV_PREFIX + name for name in sorted(known))}, with __ before a name "
            "within one of them"
        )
        raise ConfigurationError(message)


def _explain(error: ValidationError, config: Path | None) -> str:
    problems = []
    for item in error.errors(include_url=False):
        name = ".".join(map(str, item["loc"])) or "settings"
        if item["type"] == "extra_forbidden":
            problems.append(f"{name}: unknown; see `gpom serve --print-config` for all names")
        else:
            got = "(hidden)" if _is_secret(item["loc"]) else repr(item["input"])
            problems.append(f"{name}: {item['msg']}, got {got}")
    sources = "" if config is None else f" (from {config}, {ENV_PREFIX}* or flags)"
    return f"bad settings{sources}: " + "; ".join(problems)


def _is_secret(place: tuple[int | str, ...]) -> bool:
    """Whether a setting may hold what nobody should read in a log."""
    return "access" in place or {"password", "options"} & {*place} != set()


def _section(model: BaseModel, indent: int) -> list[str]:
    pad = "  " * indent
    lines: list[str] = []
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            summary = (type(value).__doc__ or "").strip().splitlines()
            lines += ["", *(f"{pad}# {line}" for line in summary[:1]), f"{pad}{name}:"]
            lines += _section(value, indent + 1)
        else:
            if field.description:
                lines.append(f"{pad}# {field.description}")
            lines.append(f"{pad}{name}: {_scalar(model, name)}")
    return lines


def _scalar(model: BaseModel, name: str) -> str:
    plain = model.model_dump(mode="json", include={name})[name]
    text: str = yaml.safe_dump(plain, default_flow_style=True, allow_unicode=True, width=10_000)
    return text.removesuffix("\n").removesuffix("\n...")
