"""Files and folders of results.

``netcdf`` is the one layout of every HDF5 file (netCDF-4), ``atomic`` writes files whole or not at all, ``folder``
claims output folders, ``store`` keeps a run on its way to ``run.h5``. What needs MPI is imported by its module's name.
"""
