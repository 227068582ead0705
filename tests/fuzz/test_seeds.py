from gpom_core import wire
from tests.fuzz.seeds import main


def test_the_corpus_is_of_scans(tmp_path) -> None:
    main(tmp_path / "scans")
    scans = [wire.decode(path.read_bytes()) for path in sorted((tmp_path / "scans").iterdir())]
    assert len(scans) == 4
    assert {scan.reliable for scan in scans} == {False, True}
