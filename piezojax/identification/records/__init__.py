"""Records: file formats, units, checks, resampling."""
