"""Claiming output folders: what may be begun, replaced, gone on with."""

import pytest

from vipetsc.io.folder import BRANCHES, KINDS, PAPER, RUN, SEARCH, SWEEP, FolderError, claim_folder


def test_a_new_folder_gets_its_marker(tmp_path):
    for kind in KINDS:
        folder = tmp_path / "deep" / kind.noun
        assert not claim_folder(folder, kind, "case")
        assert [p.name for p in folder.iterdir()] == [kind.marker]
        assert (folder / kind.marker).read_text() == "case"


def test_nothing_but_results_of_the_same_kind_is_replaced(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FolderError, match="is a file"):
        claim_folder(tmp_path / "file", RUN, "case", force=True)
    with pytest.raises(FolderError, match="of this kind"):
        claim_folder(tmp_path, RUN, "case", force=True)
    shown = {RUN: "run.h5", BRANCHES: "branch-x.h5", SEARCH: "design.h5", SWEEP: "index.json", PAPER: "plan.json"}
    for kind, file in shown.items():
        folder = tmp_path / kind.noun
        claim_folder(folder, kind, "case")
        (folder / file).touch()
        for other in KINDS:
            if other is not kind:
                with pytest.raises(FolderError, match="of this kind"):
                    claim_folder(folder, other, "case", force=True)
        assert (folder / file).exists()


def test_force_replaces_and_no_force_refuses(tmp_path):
    folder = tmp_path / "run"
    claim_folder(folder, RUN, "old")
    (folder / "run.h5").touch()
    with pytest.raises(FolderError, match="exists; --force replaces what is in it, --out chooses another"):
        claim_folder(folder, RUN, "new")
    (folder / "parts").mkdir()
    with pytest.raises(FolderError, match="exists; --resume goes on with the unfinished run in it, --force"):
        claim_folder(folder, RUN, "new")
    assert (folder / "case.toml").read_text() == "old"
    assert not claim_folder(folder, RUN, "new", force=True)
    assert (folder / "case.toml").read_text() == "new"
    assert {p.name for p in folder.iterdir()} == {"case.toml", "run.h5"}  # until a new one replaces it


def test_resume_needs_the_same_results_unfinished(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(FolderError, match="holds no unfinished run to resume; leave out --resume"):
        claim_folder(folder, RUN, "a = 1", resume=True)
    claim_folder(folder, RUN, "a = 1\nb = 2")
    with pytest.raises(FolderError, match="no unfinished run"):
        claim_folder(folder, RUN, "a = 1\nb = 2", resume=True)
    (folder / "parts").mkdir()
    assert claim_folder(folder, RUN, "a = 1\nb = 2", resume=True)
    assert (folder / "parts").is_dir()
    with pytest.raises(FolderError, match=r"differing: b = 2; b = 3$"):
        claim_folder(folder, RUN, "a = 1\nb = 3", resume=True)


def test_what_may_differ_is_the_caller_s_to_say(tmp_path):
    claim_folder(tmp_path / "nnm", BRANCHES, "points = 3")
    with pytest.raises(FolderError, match="another system"):
        claim_folder(
            tmp_path / "nnm", BRANCHES, "x", resume=True, difference=lambda earlier: f"another system: {earlier}"
        )
    assert claim_folder(tmp_path / "nnm", BRANCHES, "points = 9", resume=True, difference=lambda earlier: None)
    assert (tmp_path / "nnm" / "case.toml").read_text() == "points = 9"


def test_a_sweep_goes_on_by_itself_and_force_begins_it_anew(tmp_path):
    assert not claim_folder(tmp_path / "s", SWEEP, "same", resume=None)
    (tmp_path / "s/member").mkdir()
    (tmp_path / "s/index.json").touch()
    written = (tmp_path / "s/case.toml").stat()
    assert claim_folder(tmp_path / "s", SWEEP, "same", resume=None)
    assert (tmp_path / "s/case.toml").stat() == written  # going on touches nothing
    with pytest.raises(FolderError, match="holds another sweep; --force replaces it, --out chooses another folder"):
        claim_folder(tmp_path / "s", SWEEP, "other", resume=None)
    assert (tmp_path / "s/member").is_dir()
    assert not claim_folder(tmp_path / "s", SWEEP, "other", resume=None, force=True)
    assert [p.name for p in (tmp_path / "s").iterdir()] == ["case.toml"]
