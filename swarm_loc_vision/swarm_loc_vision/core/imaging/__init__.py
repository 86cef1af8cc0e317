"""Images, cameras and sampling."""
