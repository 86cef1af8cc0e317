"""Emulated firmware of PushBots, after EDVSBoardOS of the eDVS4337."""
