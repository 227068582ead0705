"""The settings of the map in the YAML file that `gpom serve --config` reads."""

from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from gpom_core.config import MapConfig
from gpom_core.errors import ConfigurationError


def as_yaml(config: MapConfig) -> str:
    """The settings that differ from the defaults, as `gpom serve --config` reads them."""
    usual = MapConfig()
    changed = {
        name: value for name, value in config.model_dump().items() if value != getattr(usual, name)
    }
    return str(yaml.safe_dump({"map": changed}, sort_keys=False))


def read_config(path: Path | None) -> MapConfig:
    """The section `map` of a file of settings; the defaults without a file.

    Other sections are those of `gpom serve`, and passed over.

    Raises:
        ConfigurationError: it cannot be read, has no such section, or a setting is wrong.
    """
    if path is None:
        return MapConfig()
    section = _section(_load(path), path)
    try:
        return MapConfig.model_validate(section)
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(map(str, ('map', *item['loc'])))}: {item['msg']}, got {item['input']!r}"
            for item in error.errors(include_url=False)
        )
        raise ConfigurationError(f"bad settings in {path}: {problems}") from error


def _load(path: Path) -> Any:
    try:
        with path.open(encoding="utf-8") as file:
            return yaml.load(file, _Loader)  # noqa: S506 - a safe one
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror or error}") from error
    except (AttributeError, TypeError, ValueError, LookupError, yaml.YAMLError) as error:
        message = f"{path} holds no settings of a map under the key `map`: {error}"
        raise ConfigurationError(message) from error


def _section(content: Any, path: Path) -> dict[Any, Any]:
    """The settings under `map`, which are nowhere else."""
    if content is not None and not isinstance(content, dict):
        raise ConfigurationError(f"{path} holds no settings; expected `map:` and lines under it")
    content = content or {}
    if misplaced := sorted(name for name in MapConfig.model_fields if name in content):
        stands = "stands" if len(misplaced) == 1 else "stand"
        raise ConfigurationError(f"{', '.join(misplaced)} {stands} under `map:`; see {path}")
    if "map" not in content:
        message = f"{path} has no section `map`; expected the settings of the map under `map:`"
        raise ConfigurationError(message)
    section = content["map"]
    if not isinstance(section, dict):
        raise ConfigurationError(
            f"`map` of {path} is {section!r}; expected lines `name: value` under it"
        )
    return section


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, but for two entries of one name: it would forget the first."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        lines: dict[tuple[str, str], int] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue  # a list or a table is refused as a name, later
            line = key.start_mark.line + 1
            if (first := lines.get((key.tag, key.value))) is not None:
                message = (
                    f"{self.name} has {key.value!r} twice, in lines {first} and {line}: "
                    "make one of them"
                )
                raise ConfigurationError(message)
            lines[key.tag, key.value] = line
        return node
