# Hears a scene of a Nafir server. Godot 3: a child of the camera, so that it moves with it.
extends Spatial

const Core = preload("nafir_core.gd")

export var url = "ws://127.0.0.1:8000/v1/stream"
export var scene = "apartment"
export var key = "" # an API key or token, if the server asks for one
export var buffer_s = 0.08
export var sample_rate = 48000 # or 44100 or 96000; 0 takes the scene's own
export(NodePath) var origin # the node at the scene's origin; empty if that is the world's

var core = Core.new()
var _socket
var _has_ended = false
var _nodes = {} # id -> {node, clip, gain_db}
var _player = AudioStreamPlayer.new()


func _ready():
	core.scene = scene
	core.wanted_rate = sample_rate
	core.target_s = buffer_s
	add_child(_player)
	_open()


# The emitter plays a clip of the server at the node, wherever that moves; with null, what core.push_dry gives it.
func add_emitter(id, node, clip = null, gain_db = 0.0):
	_nodes[id] = {"node": node, "clip": clip, "gain_db": gain_db}


func remove_emitter(id):
	_nodes.erase(id)
	core.remove_emitter(id)


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
	_socket.connect("data_received", self, "_received")
	var headers = [] if key == "" else ["Authorization: Bearer %s" % key]
	_has_ended = _socket.connect_to_url(url, [], false, headers) != OK


func _opened(_protocol):
	_send_text(core.hello())


# Called while the socket polls, so that it must not be let go of yet.
func _ended(_was_clean = false):
	_has_ended = true


func _lost(why):
	_socket = null
	core.lost(why)


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
			_lost("no connection to %s" % url)
	core.set_listener(pose_of(self))
	for id in _nodes.keys():
		if is_instance_valid(_nodes[id].node):
			core.set_emitter(id, _nodes[id].clip, pose_of(_nodes[id].node), _nodes[id].gain_db)
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
	_play(delta)


func _send_text(message):
	var peer = _socket.get_peer(1)
	peer.set_write_mode(WebSocketPeer.WRITE_MODE_TEXT)
	peer.put_packet(to_json(message).to_utf8())


func _play(delta):
	if core.sample_rate == 0:
		return
	if _player.stream == null or _player.stream.mix_rate != core.sample_rate:
		_player.stream = AudioStreamGenerator.new()
		_player.stream.mix_rate = core.sample_rate
		_player.stream.buffer_length = buffer_s
		_player.play()
	_player.pitch_scale = core.play(_player.get_stream_playback(), delta)


func _exit_tree():
	if _socket != null:
		_socket.disconnect_from_host(1000)
