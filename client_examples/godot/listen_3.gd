# Hears a scene without a game (Godot 3): walks past a clip and prints the level of both ears ten times a second.
#
#   godot3-server --path client_examples/godot -s listen_3.gd --url=ws://127.0.0.1:8000/v1/stream --scene=apartment
extends SceneTree

const Listener = preload("nafir/nafir_listener_3.gd")

var _listener = Listener.new()
var _source = Spatial.new()
var _given = {"scene": "apartment", "clip": "woman-reading", "seconds": "5"}
var _passed_s = 0.0
var _told_s = 0.0


func _initialize():
	for word in OS.get_cmdline_args():
		var parts = word.trim_prefix("--").split("=")
		if parts.size() == 2:
			_given[parts[0]] = parts[1]
	_listener.url = _given.get("url", _listener.url)
	_listener.scene = _given.scene
	_listener.key = _given.get("key", "")
	_listener.sample_rate = int(_given.get("rate", "48000"))
	_listener.translation = Vector3(2, 1.5, -2.5)
	_listener.rotation = Vector3(0, -PI / 2, 0) # to the right, which is east
	_source.translation = Vector3(6, 1.5, -3)
	get_root().add_child(_source)
	get_root().add_child(_listener)
	_listener.add_emitter("source", _source, null if _given.clip == "live" else _given.clip)
	Engine.target_fps = 60


func _idle(delta):
	var core = _listener.core
	_passed_s += delta
	if core.state == "refused":
		printerr(core.problem)
		quit(1)
		return
	_listener.translation.x = 2.0 + 2.0 * _passed_s / float(_given.seconds)
	if _given.clip == "live" and core.sample_rate > 0:
		var samples = []
		for index in range(int(core.sample_rate * delta)):
			samples.append(0.3 * sin(index * 0.2))
		core.push_dry("source", samples)
	if _passed_s - _told_s >= 0.1:
		_told_s = _passed_s
		var left = AudioServer.get_bus_peak_volume_left_db(0, 0)
		var right = AudioServer.get_bus_peak_volume_right_db(0, 0)
		print("%.2f s  left %.1f dB  right %.1f dB  pose %d  %s  underruns %d" % [_passed_s, left, right, core.heard_pose_id, core.state, core.ears.underruns])
	if _passed_s > float(_given.seconds):
		quit()
