"""Pictures, from files only, never from a running simulation; its modules load matplotlib.

``registry`` has every figure by name and draws what folders hold; ``style`` has sizes, colours and the loop over
pictures on all ranks, ``panels`` the panels of several figures, ``sweep_members`` the data of pictures of sweeps.
The other modules are families of figures; their docstrings name the paper's.
"""
