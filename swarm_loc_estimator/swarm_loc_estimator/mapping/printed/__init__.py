"""The method of the PushBot paper as printed: particles tagged by robot on one shared grid."""
