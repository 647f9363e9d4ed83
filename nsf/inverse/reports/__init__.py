"""Results of `nsf calibrate`, `nsf sample` and `nsf design`: tables, charts, and their sources."""
