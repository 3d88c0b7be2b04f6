"""What users run: from photographs or a database to models, with everything that is told of them."""
