"""Ways that bytes take: serial ports and TCP, with deadlines."""
