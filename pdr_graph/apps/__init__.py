"""What people start: the command line, the lifelog, the server, the report and the competition protocol."""
