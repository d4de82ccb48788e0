"""What was kept, read again: tables, reports, and how a verdict came about. The service may run meanwhile."""
