"""Pictures, from files only, never from a running simulation; its modules load matplotlib.

``registry`` has every figure by name and draws what folders hold; ``style`` has sizes, colours and the loop over
pictures that ranks share, ``panels`` what figures share, ``sweep_members`` what pictures of sweeps are drawn from.
The other modules are families of figures; their docstrings name the paper's.
"""
