"""The live graph as child processes, recorded and compared with replay."""
