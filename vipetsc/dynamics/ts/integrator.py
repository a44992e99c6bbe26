"""The engine ``ts``: one trial of PETSc's explicit Runge-Kutta at a time, landing on every contact change."""

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.changes import ModeChange, stays_landed, switching
from vipetsc.contact.law import STUCK
from vipetsc.contact.search import LANDED, MISSED, RETRY, SEARCH, Landing, correct, shorten
from vipetsc.contact.tracker import LIMITS, ImpactTracker
from vipetsc.dynamics import log
from vipetsc.dynamics.drives import select_pieces
from vipetsc.dynamics.engine import Engine, FillResult, StalledError
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout, join
from vipetsc.dynamics.options import given_first_step
from vipetsc.dynamics.samples import Samples, take_sample
from vipetsc.dynamics.ts.onset import onset_fraction
from vipetsc.dynamics.ts.right_hand_side import find_change, site_motion_at, site_motion_by_rates
from vipetsc.dynamics.ts.sums import register_sums
from vipetsc.dynamics.ts.time_stepper import TimeStepper
from vipetsc.lattice.drive import Pieces
from vipetsc.parallel import StopRequest, smallest
from vipetsc.records import Record

# Measured on the built-in case up to 0.3 s, with Hertz's law (3,800 steps, 510 rejected) and the bilinear one (3,470,
# 80): of these numbers none changes the error there, 1e-8 of the largest displacement.
#
# PETSc's suggestions carry a safety factor 0.9; stretching one by this much keeps the error below the tolerance, and a
# step before a sample is saved now and then (1 % of all trials with the bilinear law, 0.1 % with Hertz's). From 1/0.9
# on, a rejected step would be tried again at its own length, for ever.
STRETCH = 1.08
# Steps of a length that the user has fixed are stretched by no more than the rounding of times.
FIXED_STRETCH = 1.0 + 1e-6
# Steps and rejected trials for each site, from one step to the next that lands on nothing, beyond which a run counts as
# stalled: a thousand times what any run has taken.
MOST_TRIALS = 10_000
# Longest step that is taken without a search for changes, as a fraction of the first step without contacts.
BLIND = 1e-6
# A time step below this many rounding units of the time does not advance it reliably.
SHORTEST_STEP = 8 * float(np.finfo(float).eps)
# Steps in radians of the first drive's frequency: the first one, and the length with which the controller begins, for
# which any number of this size serves.
FIRST_STEP = 0.002
FREE_STEP = 0.05
# A burst rises as t^3: steps that grow with t keep even the first samples' energies in balance, to 1e-9 of the work so
# far. With twice the growth it is 2e-8, without it and the first step 9e-7; both together cost 20 steps.
STEP_PER_TIME = 0.25
# A suggestion of so many times the step taken says that the step was cut short. Not sharp: from 2 on two steps change.
CUT_SHORT = 4.0
# The rate of a reaction is its difference over so many of the site's shortest flights, to either side: 1e-5 of the
# shortest period, at which the difference errs by 1e-9 of the rate, and its rounding by less.
RATE_FLIGHTS = 10.0
# The result of a search that is left out.
NO_CHANGE = ModeChange(position=2.0, site=-1, function=0)
# An outcome of a landing in addition to those of the search: its site rests.
RESTS = -1


class Integrator(Engine):
    """Advances a lattice exactly onto given times; ``state`` and ``time`` are always an accepted step's end.

    Parameters
    ----------
    model, layout
        The lattice and its distribution.
    stop
        Looked at after every step. A request on any rank ends ``advance`` on all, at the time to which it goes or where
        a drive has a kink before that.

    PETSc options with the prefix ``ts_`` are taken last: Runge-Kutta type, tolerances, adaptor, first step. With
    ``-ts_adapt_type none -ts_dt H`` no step is longer than H; the first ones, and some to samples, are shorter.
    """

    name = "ts"
    integrates_damping = True

    def __init__(self, model: Model, layout: Layout, stop: StopRequest | None = None) -> None:
        self.comm = layout.comm
        self.layout = layout
        self.lattice = create_record(model, layout)
        self.tracker = ImpactTracker(self.lattice.contacts, layout.acting_sites)
        self.counts = dict.fromkeys(("steps", "rejected", "landings", "missed", "switches"), 0)
        self._logged = np.isin(layout.acting_sites, layout.sites)  # other ranks log the others
        self._all_sites = np.arange(len(layout.acting_sites))
        self._stop = stop or StopRequest()
        self._any_open = False
        # Whether the next step begins at an onset, after which a force is not smooth in time.
        self._after_onset = False
        # Whether the next step is taken without a search, and the steps and trials since the last that landed nowhere.
        self._is_blind = False
        self._trials = 0
        self._is_rough = any(law.onset_exponent != 1 for law in model.chain.sites.laws)

        self.time = 0.0
        self.state = layout.create_vector()
        register_sums(self.state)  # before it is duplicated
        with self.state.localForm() as local:  # its memory, which stays where it is: own components, then ghosts
            self._components = local.array
        # Only contacts of other pairs of masses, and rigid ones, need the rates of the whole state.
        self.rates = self.state
        self._needs_rates = model.chain.has_own_pairs or model.has_rigid_sites
        if self._needs_rates:
            self.rates = layout.create_vector()
        # A state a little before or after one at which reactions are asked for, and its rates.
        self._beside: list[PETSc.Vec] = []
        if model.has_rigid_sites:
            self._beside = [layout.create_vector(), layout.create_vector()]
        self.step = given_first_step(FREE_STEP / model.drive.frequency)
        self.free_step = self.step
        self._stepper = TimeStepper(model, layout, self.state, self.lattice)
        self.ts = self._stepper.ts
        self._place = np.zeros(2, np.int64)  # site and function of a change that `find_change` finds

        self._first_step = FIRST_STEP / model.drive.frequency
        self._fixed_step = PETSc.Options().getString("ts_adapt_type", "basic") == "none"
        self._interval = model.sample_interval
        self._breaks = np.unique(np.concatenate([drive.waveform.breaks for drive in model.drives]))
        self._has_pieces = any(isinstance(drive.waveform, Pieces) for drive in model.drives)
        self._most_trials = MOST_TRIALS * (len(model.chain.sites) + 1)
        self._onset_fraction = onset_fraction(model.chain.sites.laws, model.rtol)
        self.find_site_motion(self.tracker.before)

    def find_site_motion(self, motion: np.ndarray, time: float | None = None) -> None:
        """Fill ``motion`` (sites, 3) with w, w', w'' of the state at ``time`` in s, else at the present; collective."""
        if time is None:
            time = self.time
        if not self._needs_rates:
            if self.lattice.shape.exchange:
                self.state.ghostUpdate(PETSc.InsertMode.INSERT_VALUES, PETSc.ScatterMode.FORWARD)
            return site_motion_at(time, self._components, self._stepper.context_address, motion)
        self.ts.computeRHSFunction(time, self.state, self.rates)  # which updates the state's ghosts
        self.rates.ghostUpdate()
        with self.rates.localForm() as rates:
            site_motion_by_rates(self._components, rates.array, self.lattice, motion)
        if self._stepper.context["stuck"][0]:
            self._find_reactions(motion, time)

    def _find_reactions(self, motion: np.ndarray, time: float) -> None:
        """Replace the motion of stuck sites by their reaction R, its rate R', 0 at ``time`` in s; collective.

        The state and its ``rates`` are those of that time. The rate is a difference over a time in which the state
        moves straight on.
        """
        contacts = self.tracker.contacts
        reaction = contacts["reaction"].copy()
        shift = RATE_FLIGHTS * float(contacts["flight"].max(initial=0.0))
        shift = self.comm.allreduce(shift, MPI.MAX)
        state, rates = self._beside
        reactions = []
        for sign in (-1, 1):
            state.waxpy(sign * shift, self.rates, self.state)
            self.ts.computeRHSFunction(time + sign * shift, state, rates)
            reactions.append(contacts["reaction"].copy())
        contacts["reaction"] = reaction

        stuck = np.flatnonzero(np.abs(contacts["mode"]) == STUCK)
        side = np.sign(contacts["mode"][stuck])
        before, after = reactions
        motion[stuck, 0] = side * reaction[stuck]
        motion[stuck, 1] = side * (after - before)[stuck] / (2 * shift)
        motion[stuck, 2] = 0.0

    def set_motion(self, cells: np.ndarray, motion: np.ndarray, energy: float) -> None:
        self.layout.place(cells, energy, self.state.array)
        self.tracker.close_at_start(motion)
        self._restart(True)

    def fill(self, samples: Samples) -> FillResult:
        """Go on through ``samples`` and take them; a sample at which it stops is not taken."""
        record = Record(samples)
        for k in range(len(samples.work)):
            sys.audit("vipetsc.step")
            try:
                goes_on = self.advance((samples.number + k) * self._interval)
            except StalledError as error:
                return FillResult(k, stalled=str(error))
            if not goes_on:
                return FillResult(k, stopped=True)
            take_sample(self._components, k, record, self.lattice.contacts, self._all_sites)
        return FillResult(len(samples.work))

    def advance(self, target: float) -> bool:
        """Go on to the sample at ``target`` in s and take none; False if a stop was requested, on all ranks.

        Raises StalledError, on all ranks, where no step can be taken.
        """
        # The end of a drive or of a piece of one is a kink: a step ends there.
        first = self._breaks.searchsorted(self.time, "right")
        last = self._breaks.searchsorted(target)
        times = [*self._breaks[first:last].tolist(), target]
        return all(self._advance_smoothly(time) for time in times)

    def _advance_smoothly(self, target: float) -> bool:
        """Go on as ``advance`` does, to a time before which no drive has a kink."""
        if self._has_pieces:
            select_pieces(self.lattice.drives, self.time)
            # The w'' with which the first step begins is that of the pieces that are on now.
            self.find_site_motion(self.tracker.before)

        stopped = False
        while self.time < target:
            if self._trials > self._most_trials:
                raise StalledError(f"{self._trials} steps made no progress from t = {self.time:.6g} s on")
            self._trials += 1
            if not self._step(target):
                stopped = True
        # A run that is resumed from a checkpoint here restarts, too: both then have the same bits.
        self.ts.restartStep()
        return not stopped

    def _step(self, target: float) -> bool:
        """Try a step towards ``target`` in s and land on a change within it; False if a stop was requested."""
        remaining = target - self.time
        shortest = SHORTEST_STEP * max(self.time, self.free_step)
        if remaining <= shortest:
            self.time = target
            return True

        longest = self._longest_step()
        if longest < shortest:
            raise StalledError(f"the step fell to {longest:.3g} s")
        if self._is_blind:
            longest = min(longest, max(BLIND * self.free_step, 2 * shortest))
        # Equal steps to the target: none of them is short because the others were long.
        count = math.ceil(remaining / longest)
        h = remaining / count
        if not self._try_step(h):
            return True

        # The last step ends on the target itself, not on a sum that is rounded.
        end = target
        if count > 1:
            end = self.time + h
        self.find_site_motion(self.tracker.after, end)
        change = NO_CHANGE
        if not self._is_blind:
            with log.SEARCH:
                change = self._first_change(h)

        # One reduction for both: the earliest change, and whether a stop was requested anywhere.
        position, stop = smallest(self.comm, change.position, -float(self._stop.requested))
        if position <= 1.0:
            with log.LANDING:
                self._land(h, position, change)
        else:
            self.tracker.accept_step(h)
            self.time = end
            self._after_onset = False
            # Blind steps may come in turn with landings that lead nowhere: they are no progress.
            if not self._is_blind:
                self._trials = 0
            self._is_blind = False
        return stop == 0.0

    def _longest_step(self) -> float:
        """Return the longest step in s from here that the controller and the beginning of the drive allow."""
        stretch = FIXED_STRETCH if self._fixed_step else STRETCH
        return min(stretch * self.step, self._first_step + STEP_PER_TIME * self.time)

    def _try_step(self, h: float) -> bool:
        """Try a step of ``h`` s and go on with the length that PETSc suggests; False if it was rejected, and undone."""
        trial = self._stepper.try_step(self.time, h, self._after_onset)
        if not trial.accepted:
            self.step = trial.suggestion
            self.counts["rejected"] += 1
            return False

        self.counts["steps"] += 1
        # A step cut short to meet a sample says little about the longest one possible: only that it is no shorter.
        if not self._fixed_step and (trial.suggestion < CUT_SHORT * h or trial.suggestion > self.step):
            self.step = trial.suggestion
        return True

    def _first_change(self, h: float) -> ModeChange:
        """Return the first change of this rank's sites in the step of ``h`` s that was just tried."""
        position = find_change(self._stepper.context_address, self.tracker.before, self.tracker.after, h, self._place)
        return ModeChange(position, *self._place.tolist())

    def _land(self, h: float, position: float, change: ModeChange) -> None:
        """Step from the saved state onto the change at ``position`` in the step just tried, and switch there.

        ``change`` is this rank's first one; the rank whose position is the smallest judges the landing for all.
        """
        comm = self.comm
        tracker = self.tracker
        candidate = comm.size
        if change.position == position:
            candidate = comm.rank
        # A site whose motion is NaN would land for ever; all ranks learn of it by the reduction that finds the owner.
        if not np.isfinite(tracker.after).all():
            candidate = -1
        owner = comm.allreduce(candidate, MPI.MIN)
        if owner < 0:
            raise StalledError("the motion of a site is not finite")

        attempt = Landing(length=position * h, longest=h, residual=np.inf, attempts=0)
        outcome = RETRY
        self.counts["landings"] += 1
        sys.audit("vipetsc.landing")
        while outcome == RETRY:
            length = attempt.length
            if length <= SHORTEST_STEP * max(self.time, self.free_step):
                self._stepper.undo_step()
                self._switch_at_start(owner, change)
                return
            trial = self._stepper.repeat_step(self.time, length, self._after_onset)
            if not trial.accepted:
                self.step = trial.suggestion
                return
            self.find_site_motion(tracker.after, self.time + length)
            if comm.rank == owner:
                attempt, outcome = self._judge(attempt, change)
            attempt, outcome = comm.bcast((attempt, outcome), owner)

        tracker.accept_step(length)
        self.time += length
        self._after_onset = False
        if outcome == LANDED:
            self._switch()
        elif outcome == RESTS:
            self._rest(owner, change)
        else:
            self.counts["missed"] += 1

    def _judge(self, attempt: Landing, change: ModeChange) -> tuple[Landing, int]:
        """Return the next attempt at ``change`` after one that ended at the tracker's ``end``, and whether to make it.

        Where it has landed without having moved since it last did, its site is to rest.
        """
        tracker = self.tracker
        site = change.site
        value, rate, tolerance, _ = switching(tracker.contacts, site, change.function, tracker.after[site])
        attempt, outcome = correct(attempt, value, rate, tolerance, goal=tolerance)
        if outcome == LANDED:
            start = tracker.before[site]
            if stays_landed(tracker.contacts[site], start, tracker.after[site], attempt.length, np.empty(6)):
                outcome = RESTS
        if outcome != SEARCH:
            return attempt, outcome

        # A graze: short of it, go on from here; beyond it, search again on the shorter step.
        position = self._first_change(attempt.length).position
        if position > 1.0:
            return attempt, MISSED
        return shorten(attempt, position), RETRY

    def _switch_at_start(self, owner: int, change: ModeChange) -> None:
        """Switch at a ``change`` of the rank ``owner`` that lies at the start of a step, or let its site rest.

        Where nothing would switch and the site cannot rest, the next step would find the same change: it is taken
        without a search.
        """
        tracker = self.tracker
        site = change.site
        rests = False
        is_blind = False
        if self.comm.rank == owner:
            start = tracker.before[site]
            value, rate, tolerance, _ = switching(tracker.contacts, site, change.function, start)
            if rate <= 0.0:
                rests = bool(stays_landed(tracker.contacts[site], start, start, 0.0, np.empty(6)))
                is_blind = not rests and value <= tolerance
        rests, self._is_blind = self.comm.bcast((rests, is_blind), owner)
        if rests:
            self._rest(owner, change)
        elif not self._is_blind:
            self._switch()

    def _rest(self, owner: int, change: ModeChange) -> None:
        """Let the site of a ``change`` of the rank ``owner`` rest, and set the step with which to go on."""
        number = -1
        if self.comm.rank == owner:
            number = int(self.tracker.tracks.sites["number"][change.site])
        number = self.comm.bcast(number, owner)
        was_free = not self._any_open
        losses = self.layout.losses(self.state.array_r)
        self.tracker.rest(number, self.time, losses)
        self._put_losses(losses)
        self._apply_impulses()
        self._restart(was_free)

    def _switch(self) -> None:
        """Switch modes of all landed sites and set the step with which to go on."""
        was_free = not self._any_open
        before = self.tracker.contacts["mode"].copy()
        losses = self.layout.losses(self.state.array_r)
        self.tracker.switch(self.time, losses)
        self._put_losses(losses)
        self._apply_impulses()
        switched = (before != self.tracker.contacts["mode"]) | (self.tracker.impulses != 0.0)
        self.counts["switches"] += int(switched[self._logged].sum())
        self._restart(was_free)

    def _put_losses(self, losses: np.ndarray) -> None:
        """Put the ledger's ``losses`` (site,) in J of this rank's own sites into the state."""
        self.state.array[self.layout.dissipated : self.layout.size] = losses[self._logged]

    def _apply_impulses(self) -> None:
        """Add what has struck rigid sites to the velocities of this rank's own masses."""
        tracker = self.tracker
        for i in np.flatnonzero(tracker.impulses):
            site = tracker.contacts[i]
            impulse = tracker.impulses[i]
            host, resonator, _ = self.lattice.site_dofs[i]
            if host["cell"] >= 0:
                self.state.array[host["v"]] += impulse * site["host_inverse"]
            if resonator["cell"] >= 0:
                self.state.array[resonator["v"]] -= impulse * site["resonator_inverse"]

    def _count_stuck(self) -> None:
        """Let the right-hand side know whether any rank has a stuck site; collective where there are rigid sites."""
        if self._beside:
            stuck = np.count_nonzero(np.abs(self.tracker.contacts["mode"]) == STUCK)
            self._stepper.context["stuck"] = self.comm.allreduce(stuck)

    def _restart(self, was_free: bool) -> None:
        """Set the step with which to go on from a state whose sites have new modes."""
        self._count_stuck()
        shortest = self.comm.allreduce(self.tracker.contact_time(), MPI.MIN)
        self._any_open = bool(np.isfinite(shortest))
        # After any change: where no contact has just begun the root of time does no harm, and ranks need not agree.
        self._after_onset = self._any_open and self._is_rough
        if self._any_open and not self._fixed_step:
            if was_free:
                self.free_step = self.step
            self.step = min(self.step, self._onset_fraction * shortest)
        elif not was_free:
            self.step = self.free_step
        self.find_site_motion(self.tracker.before)
        self.ts.restartStep()

    def take_episodes(self, unfinished: bool = False) -> np.ndarray:
        """Return episodes of the owned sites closed since the last call, ``unfinished`` ones too."""
        episodes = self.tracker.take_episodes(self.layout.losses(self.state.array_r), unfinished)
        return episodes[np.isin(episodes["site"], self.layout.sites)]

    def statistics(self) -> dict[str, Any]:
        """Return steps, and what landings and limits of the contact law there were."""
        limits = self.tracker.counts[self._logged]
        totals = np.array([self.counts["switches"], *(limits[name].sum() for name in LIMITS)])
        self.comm.Allreduce(MPI.IN_PLACE, totals, MPI.SUM)
        per_site = dict(zip(("switches", *LIMITS), totals.tolist(), strict=True))
        return self.counts | per_site | {"method": self.ts.getRKType()}

    def checkpoint(self) -> dict[str, np.ndarray]:
        return self.layout.checkpoint(self.state.array_r) | {
            "sites": self.tracker.checkpoint()[self._logged],
            "time": np.array(self.time),
            "steps": np.array([self.step, self.free_step, self._any_open, self._after_onset, self._is_blind], float),
            "counts": np.array([list(self.counts.values())]),
        }

    def restore(self, checkpoints: Sequence[Mapping[str, np.ndarray]]) -> None:
        common = checkpoints[0]
        tables = join(checkpoints, {"sites": "number", "counts": None})
        self.layout.restore(checkpoints, self.state.array)
        self.tracker.restore(tables["sites"])
        self.time = float(common["time"])
        self.step, self.free_step, any_open, after_onset, is_blind = common["steps"].tolist()
        self._any_open = bool(any_open)
        self._after_onset = bool(after_onset)
        self._is_blind = bool(is_blind)
        self.counts = dict(zip(self.counts, common["counts"][0].tolist(), strict=True))
        # A rank counts the switches of its own sites: those so far are rank 0's from now on.
        self.counts["switches"] = 0
        if self.comm.rank == 0:
            self.counts["switches"] = int(tables["counts"][:, -1].sum())
        self._count_stuck()
        self.ts.restartStep()
        self.find_site_motion(self.tracker.before)

    def destroy(self) -> None:
        self._stepper.destroy()
        for vector in (self.state, self.rates, *self._beside):
            vector.destroy()
