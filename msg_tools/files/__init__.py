"""Safe reading of untrusted files, and atomic writing of folders; imports no other package here."""
