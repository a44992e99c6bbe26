"""The section ``[nfrc]``."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from vipetsc.case.case_file import Section
from vipetsc.case.schema import Finite, Positive, once
from vipetsc.case.varied_key import is_key

Restitution = Annotated[float, Field(ge=0, le=1)]
IsolaSearch = Literal["amplitudes", "sweeps", "breathers"]


class NfrcTable(Section):
    """Steady responses of the sites to an incident ``wave`` of a ``band``, or to a ``force`` on the driven mass.

    With ``drive.end`` the force is that of a wall that moves.

    Curves run ``over`` the amplitude (of a wave: the relative displacement that it alone would make at the first site,
    over the clearance there; of a force: N; of a wall: m) or the frequency (rad/s), within the ``range`` [low, high].
    There is one for each value of the other in ``fixed`` (frequencies: by default the drive's; amplitudes must be
    given), each of the ``restitutions`` (by default that of ``[contacts]``), and each combination of the values of
    further keys in ``family``, which are lists or ranges as in ``[sweep]``. Over the path of a key
    (``contacts.clearance``, in the key's unit) ``fixed`` are amplitudes, at the drive's frequency, and the case is
    resolved anew at each value.

    The lattice is ``infinite``, or ends where its cells do: always if it has dashpots or cells that differ, and under a
    force also by default if contacts join other masses than the cell's pair. With ``open_ends`` equal cells without end
    take the place of its absorbing ends. ``harmonics`` is the number of the last one; motions that are not
    ``symmetric`` (w(t + T/2) = -w(t)), as those of contacts that differ on their two sides, have even ones too.

    Besides folds, ``special_points`` are located: Neimark-Sacker, period-doubling and branch points where states become
    stable or unstable, or ``all`` where the number of growing perturbations changes. At ``isolas`` places within the
    range isolated curves are looked for as ``isola_search`` says: by ``amplitudes`` up to ``isola_reach`` times larger
    or smaller, from the motion in ``sweeps`` up and down of ``isola_periods`` periods from one place to the next, or
    near ``breathers``, the free motions of the lattice without loss. Steps are in units of the clearance and of the
    amplitude that touches, or half the range of frequencies.
    """

    source: Literal["wave", "force"] = "wave"
    infinite: bool | None = None
    open_ends: bool = False
    band: Annotated[int, Field(ge=1)] | None = None
    direction: Literal["forward", "backward"] = "forward"
    over: str = "amplitude"
    range: list[Finite] = Field([0.5, 2.0], min_length=2, max_length=2)
    fixed: Annotated[list[Positive], AfterValidator(once)] = Field([])
    restitutions: Annotated[list[Restitution], AfterValidator(once)] = Field([])
    family: dict[str, Any] | None = None
    harmonics: int = Field(41, ge=1, le=2000)
    symmetric: bool | None = None
    isolas: int = Field(0, ge=0, le=1000)
    isola_search: Annotated[list[IsolaSearch], AfterValidator(once)] = Field(["amplitudes"], min_length=1)
    isola_reach: float = Field(10.0, gt=1, le=1e3)
    isola_periods: int = Field(100, ge=1, le=1_000_000)
    special_points: Literal["stability", "all"] = "stability"
    points: int = Field(1000, ge=1)
    first_step: Positive = 0.02
    smallest_step: Positive = 1e-9
    largest_step: Positive = 0.1
    tolerance: Positive = 1e-11
    max_newton: int = Field(10, ge=1)

    @property
    def varies_key(self) -> bool:
        """Whether a key of the case varies along the curves."""
        return is_key(self.over)

    @property
    def towards(self) -> int:
        """+1 for a wave to higher cells, -1 to lower ones."""
        return 1 if self.direction == "forward" else -1
