"""Listening tests: people say by ear which responses are nearest to the truth.

`nafir-train listening-test` writes a test as a folder; `nafir listening-test` serves it as a page; `nafir
listening-results` counts the answers.
"""
