"""Answers to one question: at this time, what is where?"""
