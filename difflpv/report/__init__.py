"""Reports: figures (``figures``) and one self-contained page (``page``) from plain numbers and images."""
