"""Reading and writing of bags: MCAP and SQLite files, metadata, videos."""
