// SPDX-License-Identifier: MIT
// Follow the surface of a live map on a tsfusion server from C++. The format: docs/reference/wire.md.
//
//     g++ -std=c++17 -O2 -DMSGPACK_NO_BOOST examples/cpp/viewer.cpp -o viewer -lzmq
//     ./viewer tcp://127.0.0.1:5556 SECONDS
//
// Prints the number of triangles whenever cells of the map change. The address is that of the control port.

#include <msgpack.hpp>
#include <zmq.h>

#include <array>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <iostream>
#include <map>
#include <string>
#include <vector>

using Fields = std::map<std::string, msgpack::object>;

int main(int, char** words) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(std::stod(words[2]));
    void *context = zmq_ctx_new(), *server = zmq_socket(context, ZMQ_DEALER);
    const int patience_ms = 5000, none = 0;
    zmq_setsockopt(server, ZMQ_RCVTIMEO, &patience_ms, sizeof patience_ms);
    zmq_setsockopt(server, ZMQ_LINGER, &none, sizeof none);
    zmq_connect(server, words[1]);
    std::map<std::array<std::int32_t, 3>, int> triangles;  // of each cell
    std::int64_t since = 0;
    std::string epoch;
    for (int number = 1; std::chrono::steady_clock::now() < end; ++number) {
        msgpack::sbuffer command;
        msgpack::packer<msgpack::sbuffer> pack(command);
        pack.pack_map(5);
        pack.pack("type"), pack.pack("command"), pack.pack("name"), pack.pack("ask"), pack.pack("number"), pack.pack(number);
        pack.pack("timeout_s"), pack.pack(5.0), pack.pack("question"), pack.pack_map(4);
        pack.pack("type"), pack.pack("cells"), pack.pack("since"), pack.pack(since), pack.pack("epoch"), pack.pack(epoch);
        pack.pack("wait_s"), pack.pack(1.0);
        zmq_send(server, command.data(), command.size(), 0);

        std::vector<std::string> frames;
        int more = 1;
        for (std::size_t size = sizeof more; more; zmq_getsockopt(server, ZMQ_RCVMORE, &more, &size)) {
            zmq_msg_t part;
            zmq_msg_init(&part);
            if (zmq_msg_recv(&part, server, 0) < 0) return std::cerr << "no server answers\n", 1;
            frames.emplace_back(static_cast<char*>(zmq_msg_data(&part)), zmq_msg_size(&part));
            zmq_msg_close(&part);
        }
        auto handle = msgpack::unpack(frames[0].data(), frames[0].size());
        auto reply = handle.get().as<Fields>();
        if (!reply.count("answer")) return std::cerr << reply["error"] << "\n", 1;
        auto answer = reply["answer"].as<Fields>();
        std::map<std::string, std::string> arrays;
        std::size_t frame = 0;
        for (auto& layout : answer["arrays"].as<std::vector<std::vector<msgpack::object>>>())
            arrays[layout[0].as<std::string>()] = frames.at(++frame);
        epoch = answer["state"].as<Fields>()["epoch"].as<std::string>();
        std::memcpy(&since, arrays["until"].data(), sizeof since);
        if (arrays["begins"][0]) triangles.clear();  // the server's process is another one
        auto cells = reinterpret_cast<const std::array<std::int32_t, 3>*>(arrays["cells"].data());
        auto first = reinterpret_cast<const std::int32_t*>(arrays["first_face"].data());
        const std::size_t count = arrays["cells"].size() / sizeof *cells;
        for (std::size_t i = 0; i < count; ++i) triangles[cells[i]] = first[i + 1] - first[i];
        std::int64_t all = 0;
        for (auto& [cell, its] : triangles) all += its;
        if (count) std::cout << all << " triangles" << std::endl;
    }
    zmq_close(server);
    zmq_ctx_term(context);
}
