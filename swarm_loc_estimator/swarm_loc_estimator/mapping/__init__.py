"""Cooperative mapping: many robots that turn and look along one beam, one map."""
