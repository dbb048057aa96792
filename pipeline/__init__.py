"""The science: functions on arrays and records, with no files, no clock, no SPICE and no Dask."""
