import importlib
import pkgutil

import pytest

import gpom_core
import service
from gpom_core.errors import GpomError
from service.errors import BusyError, NotReadyError
from service.problems import KINDS, problem_of


def _import_all(package) -> None:
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)


def _tree(error: type[GpomError]) -> set[type[GpomError]]:
    return {error}.union(*(_tree(child) for child in error.__subclasses__()))


def test_every_error_has_a_status() -> None:
    _import_all(gpom_core)
    _import_all(service)
    ours = {error for error in _tree(GpomError) if not error.__module__.startswith("clients")}
    missing = {
        error.__name__ for error in ours - KINDS.keys() if not error.__name__.startswith("_")
    }
    assert not missing


def test_names_of_problems_differ() -> None:
    assert len({kind.name for kind in KINDS.values()}) == len(KINDS)


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_statuses_are_errors(kind) -> None:
    assert 400 <= kind.status < 600


def test_a_new_leaf_takes_after_its_parent() -> None:
    class _VeryBusyError(BusyError):
        pass

    assert problem_of(_VeryBusyError("x", 3)).headers == {"Retry-After": "3"}


def test_unexpected_errors_tell_nothing_about_the_inside() -> None:
    document = problem_of(KeyError("secret")).document()
    assert document["status"] == 500
    assert "secret" not in str(document)


def test_not_ready_lists_why() -> None:
    assert problem_of(NotReadyError(["a", "b"])).document()["troubles"] == ["a", "b"]
