"""All reading and writing of files, as Kedro datasets; nothing here knows of models.

Where logs come from is a catalog entry: :class:`~.file_logs.FileLogs` lists a folder of a logger's
files, :class:`~.array_logs.ArrayLogs` files in the published authors' array layout;
:class:`~.published_logs.PublishedLogs` first fetches such files and
:class:`~.simulated_logs.SimulatedLogs` first writes them. What is kept of them, labelled as
:mod:`gyro_pipeline.conventions` says, :mod:`~.recordings` stores as netCDF one by one.
:class:`~.tables.Table` keeps tables as CSV, :mod:`~.reports` writes what people read. Every file
is written under a temporary name and renamed when complete, so that an interrupted run leaves the
old file or the new one, never half of one.
"""
