"""The running station: from triggers to results that the PLC reads, for months."""
