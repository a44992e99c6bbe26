"""Tables of contact sites."""

from __future__ import annotations

from vipetsc.lattice import Contact, Pair, sites_at


def test_sites_that_all_differ_are_numbered_without_comparing_all_of_them(monkeypatch):
    """A million sites may have a law each: laws are found by their hashes, not one after the other."""
    compared = 0
    equal = Contact.__eq__

    def counted(one: Contact, other: object) -> bool:
        nonlocal compared
        compared += 1
        return equal(one, other)

    monkeypatch.setattr(Contact, "__eq__", counted)
    laws = [Contact("hertz", 1e6 + number) for number in range(300)]
    # Some laws come twice, as other objects.
    laws += [Contact("hertz", 1e6 + number) for number in range(100)]
    sites = sites_at(range(400), Pair(0, 1), laws)
    assert compared < 10 * len(laws)
    assert len(sites.laws) == 300
    assert [site.law.stiffness for site in sites] == [law.stiffness for law in laws]
