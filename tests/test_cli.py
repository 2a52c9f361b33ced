"""What the scripts share: errors before the work, and in one line."""

from __future__ import annotations

import pytest

from egoskin.cli import check_output, clear_errors
from egoskin.workers import WorkerError


def test_a_file_that_cannot_be_written_is_told_of_before_the_work(tmp_path):
    check_output(None, "--json")
    check_output(tmp_path / "new.json", "--json")
    with pytest.raises(ValueError, match=r"--json: there is no folder .*none"):
        check_output(tmp_path / "none" / "new.json", "--json")
    with pytest.raises(ValueError, match=r"--json: .* is a folder"):
        check_output(tmp_path, "--json")


def test_a_worker_that_ends_is_one_line():
    with pytest.raises(SystemExit, match="error: worker 0 died"), clear_errors():
        raise WorkerError("worker 0 died")
