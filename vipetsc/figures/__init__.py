"""Pictures, from files only, never from a running simulation; its modules load matplotlib.

``registry`` has every figure by name and draws what folders hold; ``style`` has sizes, colours and the loop over
pictures on all ranks, ``panels`` the panels that several figures have, ``sweep_members`` the data of pictures of
sweeps. The other modules are families of figures, or tools that several of them use; docstrings name the figures of the
paper (see ``frequency_energy``).
"""
