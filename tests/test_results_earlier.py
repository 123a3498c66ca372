"""What a file keeps of the scene that its earlier frames ran with."""

from __future__ import annotations

import json

import torchfilm as tf


def made(u, s, p, cell):
    return {"gfp": p.make - u.gfp}


def lit(make, dt=0.05):
    circuit = tf.Circuit(made, species="gfp", make=make)
    return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, dim=2, dt=dt)


def resumed(scene, path, until, changed=True):
    with tf.Results(path) as results:
        state = results.state(scene, changed=changed)
    record = tf.Recorder(path, scene, append=True, changed=changed)
    return tf.simulate(scene, state, until=until, record=record).last()


def earlier(path):
    with tf.Results(path) as results:
        return json.loads(results.attributes.get("earlier", "[]")), len(results)


def test_a_single_number_that_a_resumed_run_changes_is_kept(tmp_path):
    path = tmp_path / "run.h5"
    tf.simulate(lit(0.5), until=1.0, record=path).last()
    assert earlier(path)[0] == []
    first = earlier(path)[1]
    resumed(lit(0.5), path, 1.5, changed=False)
    assert earlier(path)[0] == []
    second = earlier(path)[1]
    resumed(lit(1.25), path, 2.0)
    found, third = earlier(path)
    assert first < second < third
    (was,) = found
    assert was["frames"] == second and was["dt"] == 0.05
    (circuit,) = was["effects"]
    assert "make: 0.5" in circuit
    resumed(lit(0.75), path, 2.5)
    assert [run["frames"] for run in earlier(path)[0]] == [second, third]
    assert "make: 1.25" in earlier(path)[0][1]["effects"][0]


def test_another_step_is_kept(tmp_path):
    path = tmp_path / "run.h5"
    tf.simulate(lit(0.5), until=1.0, record=path).last()
    frames = earlier(path)[1]
    resumed(lit(0.5, dt=0.1), path, 2.0)
    with tf.Results(path) as results:
        assert results.attributes["dt"] == 0.1
    assert earlier(path)[0] == [{"frames": frames, "dt": 0.05, "effects": []}]
