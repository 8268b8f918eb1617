"""The quality of images: the columns of the paper's tables, and further ones of ours [supplement 4]."""
