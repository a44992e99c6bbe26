"""Solvers to compare with: C++ odeint, ARKODE and plain TSRK from scripts/peers, diffrax, SciPy's DOP853.

All of them solve the lattice of a case and return its velocities at the case's samples. ARKODE's root finding ends
steps where contacts change; the others step over the kinks of the contact law. They know conservative cases only.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from shutil import which

from petsc4py import PETSc

import numba
import numpy as np
from scipy.integrate import solve_ivp

from vipetsc.case import Case, Model
from vipetsc.case.case import WEAKEST
from vipetsc.lattice import Chain, Contact, ToneBurst

SOURCES = Path(__file__).parent / "peers"
BOOST = Path("/usr/include/boost/numeric/odeint.hpp")
# The last one lets g++ vectorise odeint's sums over 13 stages: a quarter off fehlberg78's time.
FLAGS = ("-O3", "-march=native", "-std=c++17", "-fopenmp-simd", "--param", "vect-max-version-for-alias-checks=100")
ARKODE = Path("/usr/include/arkode/arkode_erkstep.h")
# scripts/bench sets up this environment: diffrax needs another numpy than Debian's.
DIFFRAX = Path(__file__).parents[1] / ".venv-diffrax" / "bin" / "python"
ONE_THREAD = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"}
# A tolerance at which a peer takes longer has no row; the others are measured.
PATIENCE = 300  # seconds that a peer may take for one solution

RightHandSide = Callable[[float, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Solution:
    """Velocities (time, cell dof) in m/s in the order of ``Chain.masses``, and the CPU seconds they took."""

    velocity: np.ndarray
    seconds: float


Solver = Callable[[Case], Solution]


def parameters(model: Model) -> str:
    """Return the lattice of ``model`` as text that the peers read; raises ValueError for what they do not know."""
    chain = model.chain
    contact = model.chain.sites[0].law
    drive = model.drive
    # Refused here, not by each peer.
    if contact.restitution != 1 or chain.ends == "periodic":
        raise ValueError("the peers know conservative lattices with fixed or free ends only")
    if contact.law not in ("hertz", "bilinear"):
        raise ValueError(f"the peers know the laws hertz and bilinear, not {contact.law}")

    couplings = chain.cell.couplings()
    lines = [
        ("lattice", chain.cells, chain.cell.dofs, int(chain.ends == "fixed")),
        ("sampling", model.samples, model.sample_interval),
        ("scale", model.scale, drive.frequency),
        ("masses", *chain.cell.masses),
        ("couplings", len(couplings)),
        *(c[:4] for c in couplings),
        ("contact", int(contact.law == "hertz"), contact.stiffness, chain.cell.host, chain.cell.resonator),
        ("sites", len(chain.sites)),
        *((site.cell, site.clearance) for site in chain.sites),
        ("drive", model.drive_cell, model.drive_mass, drive.window_amplitude, drive.frequency, drive.cycles),
    ]
    return "".join(" ".join(map(str, line)) + "\n" for line in lines)


def petsc_flags() -> list[str]:
    """Return compiler flags for the PETSc of petsc4py; empty if pkg-config knows no PETSc, or another version."""
    if not which("pkg-config"):
        return []

    def ask(*options: str) -> str:
        command = ["pkg-config", *options, "PETSc"]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    # With another version the bench would compare two PETScs.
    version = ".".join(map(str, PETSc.Sys.getVersion()))
    if ask("--modversion") != version:
        return []
    return ask("--cflags", "--libs").split()


def compile_peers(folder: Path) -> dict[str, Path]:
    """Build the C++ peers into ``folder``; those that cannot be built here are left out."""
    commands = {}
    if BOOST.exists():
        commands["odeint"] = ["g++", *FLAGS, str(SOURCES / "odeint.cpp")]
    if ARKODE.exists():
        commands["arkode"] = ["g++", *FLAGS, str(SOURCES / "arkode.cpp"), "-lsundials_arkode", "-lsundials_nvecserial"]
    if which("mpicxx") and (petsc := petsc_flags()):
        commands["tsrk"] = ["mpicxx", *FLAGS, str(SOURCES / "tsrk.cpp"), *petsc]

    # All compilers run at the same time, because each takes some seconds.
    programs = {name: (folder / name).resolve() for name in commands}
    building = {name: subprocess.Popen([*commands[name], "-o", str(path)]) for name, path in programs.items()}
    ended = {name: compiler.wait() for name, compiler in building.items()}
    return {name: path for name, path in programs.items() if ended[name] == 0}


def compiled(program: Path, method: str, folder: Path) -> Solver:
    """Return a C++ peer as a solver that exchanges files in ``folder``; raises RuntimeError if it fails."""

    def solve(case: Case) -> Solution:
        model = case.model()
        given = folder / "parameters.txt"
        output = folder / "samples.bin"
        given.write_text(parameters(model))
        rtol = case.time.rtol
        command = [str(word) for word in (program, given, method, rtol, WEAKEST * rtol, output)]
        try:
            ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(f"{program.name} {method} took more than {PATIENCE} s") from error
        if ended.returncode:
            reason = (ended.stderr.strip() or "?").splitlines()[-1]
            raise RuntimeError(f"{program.name} {method} failed: {reason}")
        return _solution(output, model, json.loads(ended.stdout)["cpu_seconds"])

    return solve


def _solution(output: Path, model: Model, seconds: float) -> Solution:
    """Return the solution in the file ``output`` of a peer, doubles (sample, mass, cell)."""
    sampled = np.fromfile(output).reshape(model.samples, model.chain.cell.dofs, model.chain.cells)
    return Solution(sampled.transpose(0, 2, 1).reshape(model.samples, -1), seconds)


def diffrax(folder: Path) -> Solver:
    """Return diffrax's Dopri8 as a solver, by a process of its own that exchanges files in ``folder``.

    The process starts with the first case, so that it compiles only once, and ends when its input is closed.
    """
    given = folder / "parameters.txt"
    output = folder / "diffrax.bin"
    # The process runs on one core, as all solvers do.
    core = min(os.sched_getaffinity(0))
    command = ["taskset", "-c", str(core), str(DIFFRAX), str(SOURCES / "diffrax_dopri8.py"), str(output)]

    @cache
    def process() -> subprocess.Popen[str]:
        # With this process' PYTHONPATH diffrax would import another numpy.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | ONE_THREAD
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )

    def solve(case: Case) -> Solution:
        model = case.model()
        running = process()
        given.write_text(parameters(model))
        assert running.stdin and running.stdout
        try:
            running.stdin.write(f"{given} {case.time.rtol} {WEAKEST * case.time.rtol}\n")
            running.stdin.flush()
        except BrokenPipeError:
            pass  # the process has ended, and gives no answer below
        answer = running.stdout.readline()
        # An empty text is the end of its output.
        if not answer:
            raise RuntimeError("diffrax failed")
        return _solution(output, model, json.loads(answer)["cpu_seconds"])

    return solve


def scipys(right_hand_side: Callable[[Model], RightHandSide]) -> Solver:
    """Return SciPy's DOP853 as a solver; ``right_hand_side`` makes the right-hand side of a model."""

    def solve(case: Case) -> Solution:
        model = case.model()
        slope = right_hand_side(model)
        n = model.chain.masses().size
        times = np.arange(model.samples) * model.sample_interval
        # Displacements have one absolute tolerance and velocities another, as in the engines.
        atol = np.repeat(model.atol, n)

        begin = time.process_time()
        found = solve_ivp(slope, (0.0, times[-1]), np.zeros(2 * n), "DOP853", times, rtol=case.time.rtol, atol=atol)
        if not found.success:
            raise RuntimeError(f"DOP853 failed: {found.message}")
        return Solution(found.y[n:].T, time.process_time() - begin)

    return solve


def _pairs(chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return hosts and resonators (site,) as indices of masses, and the clearances (site,) in m."""
    first = chain.sites.cells * chain.cell.dofs
    return first + chain.cell.host, first + chain.cell.resonator, chain.sites.clearances


def plain_right_hand_side(model: Model) -> RightHandSide:
    """Return the right-hand side of ``model`` in numpy, with the stiffness as a sparse matrix."""
    stiffness = model.chain.stiffness_matrix().tocsr()
    inverse_mass = 1 / model.chain.masses()
    n = inverse_mass.size
    host, resonator, clearance = _pairs(model.chain)
    driven = model.drive_cell * model.chain.cell.dofs + model.drive_mass
    contact = model.chain.sites[0].law
    drive = model.drive

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        u = y[:n]
        force = stiffness @ -u
        w = u[resonator] - u[host]
        push = contact.elastic_force(w - clearance) - contact.elastic_force(-w - clearance)
        force[host] += push
        force[resonator] -= push
        force[driven] += drive.force(t)
        return np.concatenate([y[n:], force * inverse_mass])

    return slope


def compiled_right_hand_side(model: Model) -> RightHandSide:
    """Return the right-hand side of ``model``, compiled by numba."""
    driven = model.drive_cell * model.chain.cell.dofs + model.drive_mass
    return _compile(model.chain, model.chain.sites[0].law, model.drive, driven)


@cache
def _compile(chain: Chain, law: Contact, drive: ToneBurst, driven: int) -> RightHandSide:
    """Return the compiled right-hand side; ``driven`` is the number of the driven mass among all."""
    # numba takes the arrays and numbers of this function as constants: the kernel is compiled for one lattice.
    stiffness = chain.stiffness_matrix().tocsr()
    first = stiffness.indptr
    columns = stiffness.indices
    values = stiffness.data
    inverse_mass = 1 / chain.masses()
    n = inverse_mass.size
    host, resonator, clearance = _pairs(chain)
    contact = law.stiffness
    # The force of the laws hertz and bilinear is this power of the indentation throughout, not at its onset alone.
    exponent = law.onset_exponent
    amplitude = drive.window_amplitude
    frequency = drive.frequency
    cycles = drive.cycles
    end = drive.duration

    @numba.njit
    def slope(t: float, y: np.ndarray) -> np.ndarray:
        f = np.empty_like(y)
        for i in range(n):
            # Elements are assigned one by one, because numba takes seconds to compile the assignment of a slice.
            f[i] = y[n + i]
            total = 0.0
            for k in range(first[i], first[i + 1]):
                total -= values[k] * y[columns[k]]
            f[n + i] = total * inverse_mass[i]

        for site in range(host.size):
            h = host[site]
            r = resonator[site]
            w = y[r] - y[h]
            x = abs(w) - clearance[site]
            if x > 0.0:
                force = np.copysign(contact * x**exponent, w)
                f[n + h] += force * inverse_mass[h]
                f[n + r] -= force * inverse_mass[r]

        if 0.0 < t < end:
            phase = frequency * t
            f[n + driven] += amplitude * (1.0 - np.cos(phase / cycles)) * np.sin(phase) * inverse_mass[driven]
        return f

    # The first call compiles the function, which is no part of a solution's time.
    slope(0.0, np.zeros(2 * n))
    return slope


def peers(folder: Path) -> dict[str, Solver]:
    """Return the solvers of all peers that this machine has, by name; ``folder`` is for their programs and files."""
    programs = compile_peers(folder)
    # The program of each peer, and the name of the method in it.
    methods = {
        "odeint dopri5": ("odeint", "dopri5"),
        "odeint fehlberg78": ("odeint", "fehlberg78"),
        "ARKODE dopri5": ("arkode", "ARKODE_DORMAND_PRINCE_7_4_5"),
        "TSRK 5dp": ("tsrk", "5dp"),
        "TSRK 8vr": ("tsrk", "8vr"),
    }
    solvers = {}
    for name, (program, method) in methods.items():
        if program in programs:
            solvers[name] = compiled(programs[program], method, folder)
    if DIFFRAX.exists():
        solvers["diffrax Dopri8"] = diffrax(folder)
    solvers["DOP853 numba"] = scipys(compiled_right_hand_side)
    solvers["DOP853 numpy"] = scipys(plain_right_hand_side)
    return solvers
