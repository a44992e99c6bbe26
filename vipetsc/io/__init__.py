"""Files and folders of results.

``netcdf`` is the one layout of every HDF5 file (netCDF-4), ``atomic`` writes files whole or not at all, ``hdf5`` those
of HDF5, ``folder`` claims folders of results, ``store`` stores the ``chunks`` of a run and assembles ``run.h5``,
``records`` has those of many runs, ``read`` opens results, ``tables`` reads tables of text. This module imports none of
them: some need MPI, and figures, which use the others, load without it.
"""
