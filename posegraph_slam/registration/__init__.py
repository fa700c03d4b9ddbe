"""Registration of point sets and scans: one result type, several matchers."""
