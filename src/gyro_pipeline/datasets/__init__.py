"""All reading and writing of files, as Kedro datasets; nothing here knows of models.

Where logs come from is a catalog entry: :class:`~.array_logs.ArrayLogs` reads files in the
published authors' array layout, :class:`~.published_logs.PublishedLogs` first fetches such files
and :class:`~.simulated_logs.SimulatedLogs` first writes them; all return the labelled arrays that
:mod:`gyro_pipeline.conventions` describes. :class:`~.recordings.Recordings` keeps these as
netCDF, :class:`~.tables.Table` keeps tables as CSV, and :mod:`~.reports` writes what people read.
Every file is written under a temporary name and renamed when complete, so that an interrupted
run leaves the old file or the new one, never half of one.
"""
