"""The UTIAS multi-robot cooperative localization and mapping dataset."""
