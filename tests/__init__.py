"""Tests of blastjax."""
