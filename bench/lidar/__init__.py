"""Robots with lidars: real buildings, known maps, starts anywhere, headers as drivers write them."""
