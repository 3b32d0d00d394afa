"""Safe reading of untrusted files, and atomic writing of folders and files."""
