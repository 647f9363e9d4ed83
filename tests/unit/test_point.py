"""What `nsf point` prints."""

import pytest

from nsf.cli import main


def test_extremes_are_those_of_the_whole_path(tmp_path, capsys):
    """A cyclic path ends where it began, with next to no stress."""
    words = ["material=hencky", "path=cyclic_shear", "point.points=21", f"point.folder={tmp_path}"]
    with pytest.raises(SystemExit):
        main(["point", *words])
    line = capsys.readouterr().out.splitlines()[0]
    assert line.startswith("Hencky along cyclic_shear, amplitude 0.2: pressure from ")
    assert float(line.split("up to ")[1].split()[0]) > 1e4
