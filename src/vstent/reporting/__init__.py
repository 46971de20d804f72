"""Reports: a finished case or cohort in, HTML and PDF out. Open ``page.py`` first."""
