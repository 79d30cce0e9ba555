"""The honest protocol: split by recording first, then cut windows, then judge every estimate.

Pure NumPy, pandas and xarray; knows nothing of files, networks or tracking.
"""
