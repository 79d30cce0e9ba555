"""Kedro datasets that read and write all files of the pipelines.

A catalog entry names the source of the logs: :class:`~.file_logs.FileLogs` for a folder of a
logger's files, :class:`~.array_logs.ArrayLogs` for files in the authors' array layout,
:class:`~.published_logs.PublishedLogs`, which downloads such files first, or
:class:`~.simulated_logs.SimulatedLogs`, which simulates them first. :mod:`~.recordings` stores the
usable recordings, labelled as in :mod:`gyro_pipeline.conventions`, as netCDF, one by one.
:class:`~.tables.Table` stores tables, :mod:`~.reports` writes tables, figures and pages for
readers. Every file is written under a temporary name and renamed when complete, so that an
interrupted run leaves the old file or the new file, never a partial one.
"""
