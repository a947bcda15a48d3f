# Two commands: `make demo` and `make test`. Each first creates the environment (quick when nothing changed).
# VENV says where the environment lies, OUTPUT where the demo writes.
VENV ?= .venv
OUTPUT ?= outputs/demo
export VENV
# Bytecode is kept also where a container's settings forbid it: without, each command of LeRobot compiles for 12 s first.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test lint

help:
	@echo "make demo   record, keyframe, train and evaluate on one task; then look at $(OUTPUT)/index.html"
	@echo "make test   formatting, types and all tests"
	@echo "make lint   formatting and types only"
	@echo "make setup  only the environment, in $(VENV)"

setup:
	@sh .ci/setup

demo: setup
	@$(VENV)/bin/histmv demo --output=$(OUTPUT)

test: lint
	@sh .ci/test

lint: setup
	@sh .ci/lint
