"""Messages: their kinds, schema, checks and heads, the names of objects, and how they are stored as files."""
