"""The edge of the house: file formats, units and frames. Nothing else reads or writes files."""
