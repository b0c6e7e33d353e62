# Hears a scene of a Nafir server. Godot 3: a child of the camera, so that it moves with it.
extends Spatial

# The stream is "live", was lost and is being tried again ("waiting"), or is over ("refused", "lost"). `core.problem` says why.
signal state_changed(state)
# The clip of an emitter is over, with its reverberation.
signal emitter_ended(id)
# The server does not take a listener beside the first, which is forgotten.
signal listener_refused(id, problem)

const Core = preload("nafir_core.gd")

export var url = "ws://127.0.0.1:8000/v1/stream"
export var scene = "apartment"
export var key = "" # an API key or token, if the server asks for one
export var buffer_s = 0.08
export var sample_rate = 48000 # or 44100 or 96000; 0 takes the scene's own
export var give_up_after_s = 300.0 # for so long a server that is gone is tried again
export var listeners = 1 # there are going to be so many, with this one: the server keeps room for them
export(NodePath) var origin # the node at the scene's origin; empty if that is the world's

var core = Core.new()
var _socket
var _has_ended = false
var _why = "" # the connection has ended
var _code = 0
var _nodes = {} # id -> {node, clip, gain_db, options}
var _others = {} # id -> {node, head, player, ears} of listeners beside this one
var _player = AudioStreamPlayer.new()


func _ready():
	core.scene = scene
	core.wanted_rate = sample_rate
	core.target_s = buffer_s
	core.give_up_after_s = give_up_after_s
	core.listeners = listeners
	core.connect("state_changed", self, "_on_core_state_changed")
	core.connect("emitter_ended", self, "_on_core_emitter_ended")
	core.connect("emitter_refused", self, "_on_core_emitter_refused")
	core.connect("listener_refused", self, "_on_core_listener_refused")
	randomize()
	add_child(_player)
	_open()


# Somebody hears the same emitters at the node, wherever that moves: a player at a split screen, or a spectator. Returns the player of what
# is heard there, whose bus or volume you may change. `head` is one of the server's; empty for its default.
func add_listener(id, node, head = ""):
	remove_listener(id)
	_others[id] = {"node": node, "head": head, "player": AudioStreamPlayer.new(), "ears": null}
	add_child(_others[id].player)
	return _others[id].player


func remove_listener(id):
	if _others.has(id):
		_others[id].player.queue_free()
		_others.erase(id)
		core.remove_listener(id)


# The emitter plays a clip of the server at the node, wherever that moves; with null, what core.push_dry gives it. `options` are those of
# core.set_emitter.
func add_emitter(id, node, clip = null, gain_db = 0.0, options = {}):
	_nodes[id] = {"node": node, "clip": clip, "gain_db": gain_db, "options": options}


func remove_emitter(id):
	_nodes.erase(id)
	core.remove_emitter(id)


# Plays a clip once at the node's present place. Returns the id of its emitter.
func play_once(clip, node, gain_db = 0.0):
	return core.play_once(clip, pose_of(node), gain_db)


# Changes a gain over some seconds, linearly in decibels.
func set_gain(id, gain_db, ramp_s = 0.0):
	if _nodes.has(id):
		_nodes[id].gain_db = gain_db
	core.set_gain(id, gain_db, ramp_s)


# Opens a door of the scene so far, from 0, shut, to 1.
func set_door(door, openness):
	core.set_door(door, openness)


# Lets a clip fade out; `emitter_ended` follows.
func stop_emitter(id, fade_s = 0.01):
	core.stop_emitter(id, -1, fade_s)


func pose_of(node):
	var place = node.global_transform
	if origin:
		place = get_node(origin).global_transform.affine_inverse() * place
	return Core.make_pose(place.origin, place.basis.get_rotation_quat())


func _open():
	core.begin()
	core.set_listener(pose_of(self))
	_socket = WebSocketClient.new()
	_socket.set_buffers(1024, 1024, 256, 1024)
	_socket.connect("connection_established", self, "_opened")
	_socket.connect("connection_error", self, "_ended")
	_socket.connect("connection_closed", self, "_ended")
	_socket.connect("server_close_request", self, "_closing")
	_socket.connect("data_received", self, "_received")
	var headers = [] if key == "" else ["Authorization: Bearer %s" % key]
	_why = "no connection to %s" % url
	_code = 0
	_has_ended = _socket.connect_to_url(url, [], false, headers) != OK


func _opened(_protocol):
	_why = "the connection was lost"
	_send_text(core.first_message())


func _closing(code, reason):
	_why = "closed with %d: %s" % [code, reason]
	_code = code
	_has_ended = true # not every server ends the connection itself after that


# Called while the socket polls, so that it must not be let go of yet.
func _ended(_was_clean = false):
	_has_ended = true


func _lost(why, code = 0):
	_socket = null
	core.lost(why, code)


func _on_core_state_changed(state):
	emit_signal("state_changed", state)


func _on_core_emitter_ended(id):
	_nodes.erase(id)
	emit_signal("emitter_ended", id)


func _on_core_emitter_refused(id, problem):
	push_warning("Nafir: emitter %s: %s" % [id, problem])


func _on_core_listener_refused(id, problem):
	remove_listener(id)
	push_warning("Nafir: listener %s: %s" % [id, problem])
	emit_signal("listener_refused", id, problem)


func _received():
	var peer = _socket.get_peer(1)
	var packet = peer.get_packet()
	if peer.was_string_packet():
		core.receive(JSON.parse(packet.get_string_from_utf8()).result)
	else:
		var data = StreamPeerBuffer.new()
		data.data_array = packet
		core.receive_block(data)


func _process(delta):
	if _socket != null:
		_socket.poll()
		if _has_ended:
			_lost(_why, _code)
	core.set_listener(pose_of(self))
	for id in _others.keys():
		if is_instance_valid(_others[id].node):
			_others[id].ears = core.add_listener(id, pose_of(_others[id].node), _others[id].head)
		else:
			remove_listener(id)
	for id in _nodes.keys():
		if is_instance_valid(_nodes[id].node):
			core.set_emitter(id, _nodes[id].clip, pose_of(_nodes[id].node), _nodes[id].gain_db, _nodes[id].options)
		else:
			remove_emitter(id)
	match core.step(delta):
		"connect":
			_open()
		"drop":
			if _socket != null:
				_socket.disconnect_from_host()
			_lost("the server is silent")
	while _socket != null and core.texts.size() > 0:
		_send_text(core.texts.pop_front())
	while _socket != null and core.packets.size() > 0:
		var peer = _socket.get_peer(1)
		peer.set_write_mode(WebSocketPeer.WRITE_MODE_BINARY)
		peer.put_packet(core.packets.pop_front().data_array)
	_play(_player, core.ears, delta)
	for id in _others:
		_play(_others[id].player, _others[id].ears, delta)


func _send_text(message):
	var peer = _socket.get_peer(1)
	peer.set_write_mode(WebSocketPeer.WRITE_MODE_TEXT)
	peer.put_packet(to_json(message).to_utf8())


func _play(player, ears, delta):
	if ears.sample_rate == 0:
		return
	if player.stream == null or player.stream.mix_rate != ears.sample_rate:
		player.stream = AudioStreamGenerator.new()
		player.stream.mix_rate = ears.sample_rate
		player.stream.buffer_length = buffer_s
		player.play()
	player.pitch_scale = ears.play(player.get_stream_playback(), delta)


func _exit_tree():
	if _socket != null:
		_socket.disconnect_from_host(1000)
