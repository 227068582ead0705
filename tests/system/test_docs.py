"""What the pages of docs/ show is what the service takes."""

import re
from pathlib import Path

import pytest
import yaml

from service.settings import Settings

PAGES = sorted((Path(__file__).parents[2] / "docs").glob("*.md"))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_settings_in_the_docs_are_valid(page) -> None:
    for block in blocks(page, "yaml"):
        Settings.model_validate(yaml.safe_load(block))


def test_reasons_in_the_docs_are_those_that_are_counted() -> None:
    page = (PAGES[0].parent / "ros.md").read_text(encoding="utf-8")
    code = "\n".join(
        path.read_text(encoding="utf-8")
        for folder in ("service/ros", "gpom_core")
        for path in (PAGES[0].parents[1] / folder).rglob("*.py")
    )
    table = page[page.index("| reason | means |") :]
    rows = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    reasons = re.findall(r"`([a-z_]+)`", " ".join(rows))
    assert len(reasons) > 8
    assert [reason for reason in reasons if f'"{reason}"' not in code] == []
