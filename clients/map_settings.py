"""The settings of the map in the YAML file that `gpom serve --config` reads."""

from pathlib import Path

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
    """The `map` section of a file of settings; the defaults without one.

    Raises:
        ConfigurationError: it cannot be read, or a setting is wrong.
    """
    if path is None:
        return MapConfig()
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        return MapConfig(**content.get("map", {}))
    except (OSError, AttributeError, TypeError, yaml.YAMLError, ValidationError) as error:
        message = f"{path} holds no settings of a map under the key `map`: {error}"
        raise ConfigurationError(message) from error
