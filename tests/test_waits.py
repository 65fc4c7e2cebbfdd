"""Nothing in bevcli waits for ever: each call that can wait has a time limit, or stands here with its reason."""

import ast

from source_code import ROOT, trees

# Calls that wait without a limit, by file.
ALLOWED = {
    (
        "workshop/batch/job.py",
        "ThreadPoolExecutor",
    ): "the tasks read files; packages of object stores have time limits of their own",
    (
        "workshop/batch/report.py",
        "ThreadPoolExecutor",
    ): "the tasks read files; packages of object stores have time limits of their own",
    (
        "workshop/batch/run_batch.py",
        "ThreadPoolExecutor",
    ): "the tasks read files; packages of object stores have time limits of their own",
    (
        "workshop/batch/storage.py",
        "ThreadPoolExecutor",
    ): "the tasks read files; packages of object stores have time limits of their own",
    ("cli/bridge.py", "_flags.get"): "a context variable, not a queue",
    ("cli/stop_signals.py", "numbers.recv"): "in a daemon thread, until a signal comes or the command ends",
    ("registry.py", "installed().select"): "chooses among entry points",
    ("viewer/native.py", "process.wait"): "until the user closes the viewer's window",
    ("viewer/web.py", "self.serve_forever"): "until Ctrl-C, or `close`",
    ("recording/writer.py", "select.select"): "in a daemon thread, until rerun writes or closes the pipe",
    ("inference/preprocess.py", "task.result"): "the task is done",
    ("model/kernels/compiled.py", "helper.result"): "the tasks only compute",
    ("workshop/synth/drive.py", "ThreadPoolExecutor"): "the tasks only compute",
    ("workshop/training/samples.py", "clip.result"): "in a thread whose own result has a limit",
    ("workshop/robustness/conditions.py", "ThreadPoolExecutor"): "the tasks only compute",
    ("workshop/calibration/views.py", "ThreadPoolExecutor"): "the tasks only compute",
    ("workshop/calibration/road.py", "ThreadPoolExecutor"): "the tasks only compute",
}
# Methods that wait: name -> the number of arguments without a limit, and the keywords that limit it.
METHODS = {
    "join": (0, ("timeout",)),
    "wait": (0, ("timeout",)),
    "result": (0, ("timeout",)),
    "acquire": (0, ("timeout", "blocking")),
    "communicate": (1, ("timeout",)),
    "get": (0, ("timeout", "block")),
    "recv": (1, ()),
    "accept": (0, ()),
    "wait_for": (1, ("timeout",)),
    "serve_forever": (9, ()),
    "select": (3, ("timeout",)),
}
# Functions that wait: the keyword that limits them.
FUNCTIONS = {
    "subprocess.run": "timeout",
    "subprocess.call": "timeout",
    "subprocess.check_call": "timeout",
    "subprocess.check_output": "timeout",
    "urllib.request.urlopen": "timeout",
    "urlopen": "timeout",
    "socket.create_connection": "timeout",
    "sqlite3.connect": "timeout",
    "os.system": "",
    "os.wait": "",
    "os.waitpid": "",
    "input": "",
}


def waits(tree: ast.AST) -> set[str]:
    """The calls of a module that can wait without a limit."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.With):  # the end of the block waits for all tasks
            found |= {
                ast.unparse(item.context_expr.func)
                for item in node.items
                if isinstance(item.context_expr, ast.Call)
                and ast.unparse(item.context_expr.func).endswith("PoolExecutor")
            }
        if not isinstance(node, ast.Call):
            continue
        name, keywords = ast.unparse(node.func), {keyword.arg for keyword in node.keywords}
        limit = FUNCTIONS.get(name)
        if limit is not None and limit not in keywords:
            found.add(name)
        if isinstance(node.func, ast.Attribute) and node.func.attr in METHODS:
            most, limits = METHODS[node.func.attr]
            if len(node.args) <= most and not keywords & set(limits):
                found.add(name)
    return found


def test_every_wait_has_a_limit_or_a_reason():
    found = {(path.relative_to(ROOT).as_posix(), name) for path, tree in trees().items() for name in waits(tree)}
    assert found == set(ALLOWED)


def test_waits_without_a_limit_are_seen():
    text = "thread.join()\nthread.join(3)\nfuture.result()\nsubprocess.run(x, check=True)\nlock.acquire(timeout=1)\n"
    text += "', '.join(names)\nprocess.communicate(data)\nwith ThreadPoolExecutor(2) as pool:\n    pass\n"
    expected = {"thread.join", "future.result", "subprocess.run", "process.communicate", "ThreadPoolExecutor"}
    assert waits(ast.parse(text)) == expected
