# gsmerge on a CPU: docker build -t gsmerge . && docker run --rm -v "$PWD:/data" gsmerge compact scene.ply
FROM python:3.11-slim-bookworm

WORKDIR /opt/gsmerge
COPY pyproject.toml setup.py constraints.txt README.md LICENSE ./
COPY gsmerge gsmerge
RUN pip install --no-cache-dir -c constraints.txt .

WORKDIR /data
ENTRYPOINT ["gsmerge"]
CMD ["--help"]
