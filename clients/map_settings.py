"""The settings of the map in the YAML file that `gpom serve --config` reads."""

from pathlib import Path
from typing import Any

import yaml

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
    """The `map` section of a file of settings; the defaults without one.

    Raises:
        ConfigurationError: it cannot be read, or a setting is wrong.
    """
    if path is None:
        return MapConfig()
    try:
        with path.open(encoding="utf-8") as file:
            content = yaml.load(file, _Loader) or {}  # noqa: S506 - a safe one
        return MapConfig(**content.get("map", {}))
    except (OSError, AttributeError, TypeError, ValueError, LookupError, yaml.YAMLError) as error:
        message = f"{path} holds no settings of a map under the key `map`: {error}"
        raise ConfigurationError(message) from error


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
