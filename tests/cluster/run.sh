#!/usr/bin/env bash
# The ci configuration on a Slurm of two nodes on this machine, beside a local run: same tables, a drained node,
# a job killed for its memory, a GPU request. Needs root, control groups (v1 or v2), 4 GB of memory, and Debian's
# slurmctld, slurmd, slurm-client and munge, and hilsplat with its extra `cluster`; on Debian:
#   apt-get install --no-install-recommends slurmctld slurmd slurm-client munge
#   pip install --constraint constraints.txt --editable '.[cluster]'
#   tests/cluster/run.sh [FOLDER]        logs and both runs stay in FOLDER (default: a temporary one)
set -euo pipefail
project=$(cd "$(dirname "$0")/../.." && pwd)
folder=${1:-$(mktemp -d -t hilsplat-cluster.XXXXXX)}
folder=$(mkdir -p "$folder" && cd "$folder" && pwd)
etc=/etc/slurm # srun inside a job forgets SLURM_CONF, so the configuration must lie here
mark="# written by hilsplat's tests/cluster/run.sh"

fail() { echo "FAILED: $*" >&2; exit 1; }
[ "$(id -u)" = 0 ] || fail "only root can start Slurm's daemons"
for program in slurmctld slurmd sbatch munged; do
    command -v $program > /dev/null || fail "$program is missing: see the first lines of $0"
done
python -c "import snakemake_executor_plugin_slurm" || fail "hilsplat's extra cluster is missing: see the first lines of $0"
if [ -e $etc/slurm.conf ] && ! grep -q "^$mark" $etc/slurm.conf; then fail "this machine has a Slurm of its own: $etc/slurm.conf"; fi

stop() {
    scancel --user root 2> /dev/null || true
    for file in "$folder"/slurm/slurmctld.pid "$folder"/slurm/slurmd-node?.pid "$folder"/slurm/munged.pid; do
        if [ -f "$file" ]; then kill "$(cat "$file")" 2> /dev/null || true; fi
    done
    rm -f $etc/slurm.conf $etc/cgroup.conf $etc/gres.conf
}
trap stop EXIT

start() {
    local slurm=$folder/slurm host
    host=$(hostname)
    rm -rf "$slurm" && mkdir -p "$slurm/state" "$slurm"/spool-node{1,2} $etc
    chmod 755 "$folder" "$slurm"
    (umask 077 && head -c 128 /dev/urandom > "$slurm/munge.key")
    munged --force --socket="$slurm/munge.socket" --key-file="$slurm/munge.key" --pid-file="$slurm/munged.pid" \
        --log-file="$slurm/munged.log" --seed-file="$slurm/munge.seed"
    cat > $etc/slurm.conf <<CONF
$mark
ClusterName=hilsplat
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$slurm/munge.socket
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
StateSaveLocation=$slurm/state
SlurmdSpoolDir=$slurm/spool-%n
SlurmctldPidFile=$slurm/slurmctld.pid
SlurmdPidFile=$slurm/slurmd-%n.pid
SlurmctldLogFile=$slurm/slurmctld.log
SlurmdLogFile=$slurm/slurmd-%n.log
ProctrackType=proctrack/cgroup
TaskPlugin=task/affinity,task/cgroup
JobAcctGatherType=jobacct_gather/cgroup
JobCompType=jobcomp/filetxt
JobCompLoc=$slurm/jobs.txt
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MinJobAge=3600
GresTypes=gpu
NodeName=node1 NodeHostname=$host NodeAddr=127.0.0.1 Port=17001 CPUs=2 RealMemory=4000 Gres=gpu:1
NodeName=node2 NodeHostname=$host NodeAddr=127.0.0.1 Port=17002 CPUs=2 RealMemory=4000 Gres=gpu:1
PartitionName=main Nodes=node1,node2 Default=YES MaxTime=INFINITE State=UP
CONF
    printf '%s\n' "CgroupAutomount=no" "ConstrainCores=yes" "ConstrainRAMSpace=yes" "AllowedSwapSpace=0" > $etc/cgroup.conf
    [ -e /sys/fs/cgroup/cgroup.controllers ] || echo "CgroupPlugin=cgroup/v1" >> $etc/cgroup.conf
    echo "Name=gpu File=/dev/zero # stands in for a GPU" > $etc/gres.conf
    slurmctld
    slurmd -N node1
    slurmd -N node2
    for _ in $(seq 30); do
        [ "$(sinfo --noheader --Node --states=idle 2> /dev/null | wc -l)" = 2 ] && return
        sleep 1
    done
    fail "the nodes do not answer: see $slurm/*.log"
}

copy() { # a project of its own, with the embedded models alone
    rm -rf "${folder:?}/$1" && mkdir -p "$folder/$1/models"
    cp -r "$project"/{Snakefile,rules,workflow,profiles,config,cpusplat,hilsplat,hilsplat_world,snakemake_logger_plugin_hilsplat} "$folder/$1"
    cp -r "$project"/models/{sam-tiny,clip-tiny} "$folder/$1/models"
}

on_slurm() {
    (cd "$folder/cluster" && PYTHONPATH=$PWD snakemake --workflow-profile profiles/slurm --configfile config/ci.yaml \
        --max-threads 2 --default-resources slurm_partition=main place=1 --slurm-no-account \
        --slurm-status-command squeue --slurm-init-seconds-before-status-checks 1 \
        --seconds-between-status-checks 1 "$@")
}

completed() { grep -c JobState=COMPLETED "$folder/slurm/jobs.txt" 2> /dev/null || true; }

drain() { # node 1, once half of the jobs have ended; what runs there ends there
    until [ "$(completed)" -ge 4 ]; do sleep 1; done
    scontrol update nodename=node1 state=drain reason=test
    date +%s > "$folder/slurm/drained"
}

copy cluster && copy local && start
drain & drainer=$!
on_slurm > "$folder/cluster.log" 2>&1 || fail "the run on Slurm: $folder/cluster.log"
wait $drainer
drained=$(date -d "@$(cat "$folder/slurm/drained")" +%Y-%m-%dT%H:%M:%S)
late=$(grep -oE "StartTime=[^ ]+ .*NodeList=node1" "$folder/slurm/jobs.txt" | cut -d" " -f1 | cut -d= -f2 |
    awk -v drained="$drained" '$1 > drained' | wc -l)
[ "$late" = 0 ] || fail "$late jobs began on the drained node"
grep -q "NodeList=node2" "$folder/slurm/jobs.txt" || fail "no job ran on node 2"
echo "ok: $(completed) jobs; node 1 drained at $drained, none began there later"
scontrol update nodename=node1 state=resume

(cd "$folder/local" && PYTHONPATH=$PWD snakemake --cores 2 --configfile config/ci.yaml) > "$folder/local.log" 2>&1 ||
    fail "the local run: $folder/local.log"
compared=0
for table in "$folder"/local/results/tables/*.csv; do
    name=$(basename "$table")
    case $name in *-seconds.csv) continue ;; esac
    cmp "$table" "$folder/cluster/results/tables/$name" || fail "table $name differs"
    compared=$((compared + 1))
done
cmp "$folder"/{local,cluster}/results/synthetic/tiny/default/field.safetensors || fail "the fields differ"
echo "ok: $compared tables and the field have the same bytes as those of the local run"

: > "$folder/slurm/jobs.txt"
half=$(grep -oE '"max_rss": [0-9]+' "$folder/local/results/synthetic/tiny/benchmarks/mask_truth.jsonl" | awk '{print int($2 / 2)}')
on_slurm --forcerun mask_truth --set-resources "mask_truth:mem_mb=$half*attempt" mask_truth:gpu=1 \
    --retries 4 -- results/figures/synthetic/tiny/masks.webp > "$folder/memory.log" 2>&1 ||
    fail "the job that ran out of memory did not finish: $folder/memory.log"
grep -q "oom-kill event" "$folder"/slurm/slurmd-node?.log || fail "no job was killed for its memory"
grep -q JobState=COMPLETED "$folder/slurm/jobs.txt" || fail "no attempt finished"
echo "ok: out of memory with $half MB, finished at attempt $(wc -l < "$folder/slurm/jobs.txt")"
scontrol show jobs | grep -q "TresPerJob=gres:gpu:1" || fail "gpu=1 did not become a GPU of Slurm"
echo "ok: gpu=1 became gres:gpu:1"
