"""Jobs that users run: from photographs or a database to models, with a summary and tables of verdicts."""
