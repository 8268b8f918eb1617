"""Tools for people: the contact sheet, and the doctor."""
