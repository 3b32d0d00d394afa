"""Bags in and out: MCAP and SQLite files, metadata, videos."""
