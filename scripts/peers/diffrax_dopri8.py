"""Peer: diffrax's Dopri8 on JAX, compiled, in double precision on one CPU thread; runs in an environment of its own.

``diffrax_dopri8.py OUTPUT`` reads lines ``PARAMETERS RTOL ATOL``. It solves each and writes the sampled velocities to
OUTPUT, in m/s as doubles, as the C++ peers do; then it prints a line of JSON. The CPU time in it is without that of
compiling. Samples are interpolated, which costs less at equal error than steps that end at them.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

# JAX computes in single precision unless this is set before its first array.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")


def words_in(path: str) -> Iterator[str]:
    """Yield the words of the parameter file ``path``, one after the other."""
    with open(path, encoding="utf-8") as file:
        yield from file.read().split()


class Lattice:
    """The lattice of a parameter file, in units of the drive's linear wave: see lattice.hpp."""

    def __init__(self, path: str) -> None:
        words = words_in(path)

        def numbers(count: int, key: str = "") -> list[float]:
            if key and next(words) != key:
                raise ValueError(f"{path}: expected {key!r}")
            return [float(next(words)) for _ in range(count)]

        self.cells, self.dofs, self.walls = map(int, numbers(3, "lattice"))
        samples, interval = numbers(2, "sampling")
        self.scale, self.rate = numbers(2, "scale")
        # With times in units of 1/Om, Om being the rate, accelerations have the factor 1/Om^2, which goes into masses.
        self.masses = np.array(numbers(self.dofs, "masses")) * self.rate**2
        self.couplings = [numbers(4) for _ in range(int(numbers(1, "couplings")[0]))]
        hertz, stiffness, host, resonator = numbers(4, "contact")
        self.exponent = 1.0
        self.stiffness = stiffness
        if hertz:
            self.exponent = 1.5
            self.stiffness = stiffness * np.sqrt(self.scale)
        self.host = int(host)
        self.resonator = int(resonator)
        sites = np.array(numbers(2 * int(numbers(1, "sites")[0]))).reshape(-1, 2)
        self.sites = sites[:, 0].astype(int)
        self.clearances = sites[:, 1] / self.scale

        cell, mass, amplitude, frequency, self.cycles = numbers(5, "drive")
        self.driven = int(mass), int(cell)
        self.drive = amplitude / (self.scale * self.masses[int(mass)])
        self.drive_rate = frequency / self.rate
        self.times = np.arange(int(samples)) * interval * self.rate

    def derivative(self, t: jax.Array, y: jax.Array, _: None) -> jax.Array:
        """Return time derivative of y (displacement or velocity, mass, cell)."""
        u = y[0]
        # Cells of zeros beyond the ends are fixed walls; at free ends their springs are left out below.
        outside = jnp.pad(u, ((0, 0), (1, 1)))
        pulls = [jnp.zeros(self.cells) for _ in range(self.dofs)]
        for mass, offset, other, stiffness in self.couplings:
            m = int(mass)
            o = int(other)
            shift = int(offset)
            strengths = np.full(self.cells, stiffness / self.masses[m])
            if shift and not self.walls:  # a free end has no spring there
                strengths[0 if shift < 0 else -1] = 0.0
            pulls[m] += strengths * (outside[o, 1 + shift : 1 + shift + self.cells] - u[m])
        acceleration = jnp.stack(pulls)

        w = u[self.resonator, self.sites] - u[self.host, self.sites]
        force = jnp.sign(w) * self.stiffness * jnp.maximum(jnp.abs(w) - self.clearances, 0.0) ** self.exponent
        acceleration = acceleration.at[self.host, self.sites].add(force / self.masses[self.host])
        acceleration = acceleration.at[self.resonator, self.sites].add(-force / self.masses[self.resonator])

        phase = self.drive_rate * t
        driving = (phase > 0) & (phase < 2 * np.pi * self.cycles)
        burst = self.drive * (1 - jnp.cos(phase / self.cycles)) * jnp.sin(phase)
        return jnp.stack([y[1], acceleration.at[self.driven].add(jnp.where(driving, burst, 0.0))])

    def solver(self) -> Callable[[float, float], diffrax.Solution]:
        """Return the compiled solution as a function of the two tolerances."""
        term = diffrax.ODETerm(self.derivative)
        times = jnp.asarray(self.times)

        @jax.jit
        def solve(rtol: float, atol: float) -> diffrax.Solution:
            control = diffrax.PIDController(rtol, atol)
            return diffrax.diffeqsolve(
                term, diffrax.Dopri8(), times[0], times[-1], 2e-3, jnp.zeros((2, self.dofs, self.cells)),
                saveat=diffrax.SaveAt(ts=times, fn=lambda t, y, args: y[1]), stepsize_controller=control,
                adjoint=diffrax.ForwardMode(), max_steps=None,
            )  # fmt: skip

        return solve


def main(output: str) -> None:
    """Solve the case of each line of stdin; the velocities go to the file ``output``, a line of JSON to stdout."""
    compiled: dict[str, tuple[Lattice, Callable[[float, float], diffrax.Solution]]] = {}
    for line in sys.stdin:
        path, rtol, atol = line.split()
        text = "\n".join(words_in(path))
        if text not in compiled:
            lattice = Lattice(path)
            # The key is the content of the file, because the files of all cases have the same name.
            compiled[text] = lattice, lattice.solver()
            # A first solution at loose tolerances compiles. Tolerances are arguments, so that others need no further
            # compilation.
            jax.block_until_ready(compiled[text][1](1e-3, 1e-4))
        lattice, solve = compiled[text]
        begin = time.process_time()
        # JAX returns before it has computed: without waiting only the call would be timed.
        found = jax.block_until_ready(solve(float(rtol), float(atol)))
        seconds = time.process_time() - begin
        (np.asarray(found.ys) * lattice.scale * lattice.rate).tofile(output)
        print(json.dumps({"cpu_seconds": seconds, "steps": int(found.stats["num_steps"])}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
