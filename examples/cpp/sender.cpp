// SPDX-License-Identifier: MIT
// Depth images and poses, sent to a tsfusion server from C++. The format: docs/reference/wire.md.
//
//     g++ -std=c++17 -O2 -DMSGPACK_NO_BOOST examples/cpp/sender.cpp -o sender -lzmq -lzstd
//     ./sender 127.0.0.1 5555 frames.txt FX FY CX CY
//
// A line of frames.txt: FILE.pgm tx ty tz qx qy qz qw (T_world_camera, metres; x right, y down, z forward).
// A file is a binary PGM of 16 bits: depth in millimetres, 0 = no return. Ends with status 0 when the server has
// every keyframe on its disk. What is not acknowledged is kept in memory here: a scanner that must survive its
// own death writes it to a disk before it sends it.

#include <msgpack.hpp>
#include <zmq.h>
#include <zstd.h>

#include <array>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <fstream>
#include <iostream>
#include <map>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using Bytes = std::vector<char>;
using Packer = msgpack::packer<msgpack::sbuffer>;

static std::int64_t now_ns() {
    return std::chrono::steady_clock::now().time_since_epoch() / std::chrono::nanoseconds(1);
}

static std::uint32_t crc32(const Bytes& bytes) {  // that of zlib and PNG
    std::uint32_t crc = ~0u;
    for (unsigned char byte : bytes) {
        crc ^= byte;
        for (int bit = 0; bit < 8; ++bit) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0u);
    }
    return ~crc;
}

struct Depth {
    int width = 0, height = 0;
    std::vector<std::uint16_t> mm;
};

static Depth read_pgm(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::string magic;
    Depth found;
    int most = 0;
    if (!(file >> magic >> found.width >> found.height >> most) || magic != "P5" || most < 256 || file.get() == EOF)
        throw std::runtime_error(path + " is no binary PGM of 16 bits");
    found.mm.resize(std::size_t(found.width) * found.height);
    for (auto& value : found.mm) {
        int high = file.get(), low = file.get();
        if (low == EOF) throw std::runtime_error(path + " ends too early");
        value = std::uint16_t(high << 8 | low);
    }
    return found;
}

// `dzp+zstd`: difference to the pixel before, folded so that its sign is the lowest bit, low bytes and then high
// bytes, Zstandard. Lossless; the frame states its size, which the server asks for.
static Bytes packed(const std::vector<std::uint16_t>& pixels) {
    Bytes planes(2 * pixels.size());
    std::uint16_t before = 0;
    for (std::size_t i = 0; i < pixels.size(); ++i) {
        std::uint16_t step = pixels[i] - before;
        std::uint16_t folded = std::uint16_t(step << 1 ^ (step & 0x8000 ? 0xFFFF : 0));
        before = pixels[i];
        planes[i] = char(folded & 0xFF);
        planes[pixels.size() + i] = char(folded >> 8);
    }
    Bytes frame(ZSTD_compressBound(planes.size()));
    std::size_t size = ZSTD_compress(frame.data(), frame.size(), planes.data(), planes.size(), 1);
    if (ZSTD_isError(size)) throw std::runtime_error(ZSTD_getErrorName(size));
    frame.resize(size);
    return frame;
}

static std::array<double, 12> pose_rows(double x, double y, double z, double a, double b, double c, double w) {
    double n = 2 / (a * a + b * b + c * c + w * w);
    return {1 - n * (b * b + c * c), n * (a * b - c * w), n * (a * c + b * w), x,
            n * (a * b + c * w), 1 - n * (a * a + c * c), n * (b * c - a * w), y,
            n * (a * c - b * w), n * (b * c + a * w), 1 - n * (a * a + b * b), z};
}

struct Keyframe {
    std::uint64_t seq;
    std::string header;
    Bytes depth;
};

class Client {
   public:
    Client(const std::string& host, int port) {
        context_ = zmq_ctx_new();
        data_ = open(ZMQ_PUSH, host, port);
        control_ = open(ZMQ_DEALER, host, port + 1);
        std::random_device random;
        for (char& byte : session_) byte = char(random());
    }

    ~Client() {
        zmq_close(data_);
        zmq_close(control_);
        zmq_ctx_term(context_);
    }

    void add(const Depth& image, const std::array<double, 4>& camera, const std::array<double, 12>& pose) {
        Keyframe made{++last_, {}, packed(image.mm)};
        msgpack::sbuffer buffer;
        Packer out(buffer);
        out.pack_map(8);
        out.pack("session"), pack_session(out);
        out.pack("seq"), out.pack(made.seq);
        out.pack("previous"), out.pack(made.seq - 1);
        out.pack("pose"), out.pack(pose);
        out.pack("intrinsics"), out.pack(camera);
        out.pack("scale"), out.pack(0.001);
        out.pack("captured_ns"), out.pack(now_ns());
        out.pack("buffers"), out.pack_array(1);
        out.pack_map(6);
        out.pack("name"), out.pack("depth");
        out.pack("codec"), out.pack("dzp+zstd");
        out.pack("dtype"), out.pack("uint16");
        out.pack("shape"), out.pack_array(2), out.pack(image.height), out.pack(image.width);
        out.pack("bytes"), out.pack(made.depth.size());
        out.pack("crc32"), out.pack(crc32(made.depth));
        made.header = std::string("TSF\x01", 4) + std::string(buffer.data(), buffer.size());
        waiting_.push_back(std::move(made));
    }

    // Exchange messages until the server has everything on its disk; an error when it does not in time.
    void flush(double seconds) {
        std::int64_t end = now_ns() + std::int64_t(seconds * 1e9);
        while (!waiting_.empty()) {
            if (now_ns() > end) throw std::runtime_error("the server does not have every keyframe: " + why_);
            step();
        }
    }

   private:
    void* open(int kind, const std::string& host, int port) {
        void* made = zmq_socket(context_, kind);
        int zero = 0, one = 1, ten = 10;
        zmq_setsockopt(made, ZMQ_LINGER, &zero, sizeof zero);
        zmq_setsockopt(made, ZMQ_IMMEDIATE, &one, sizeof one);  // nothing is queued for a server that is not there
        zmq_setsockopt(made, ZMQ_SNDHWM, &ten, sizeof ten);
        std::string address = "tcp://" + host + ":" + std::to_string(port);
        if (zmq_connect(made, address.c_str())) throw std::runtime_error(address + ": " + zmq_strerror(errno));
        return made;
    }

    void pack_session(Packer& out) const {
        out.pack_bin(sizeof session_);
        out.pack_bin_body(session_, sizeof session_);
    }

    void say_hello() {
        msgpack::sbuffer buffer;
        Packer out(buffer);
        out.pack_map(3);
        out.pack("type"), out.pack("hello");
        out.pack("session"), pack_session(out);
        out.pack("version"), out.pack(3);
        zmq_send(control_, buffer.data(), buffer.size(), ZMQ_DONTWAIT);
    }

    void say_ping() {
        msgpack::sbuffer buffer;
        Packer out(buffer);
        out.pack_map(4);
        out.pack("type"), out.pack("ping");
        out.pack("session"), pack_session(out);
        out.pack("sent_ns"), out.pack(now_ns());
        out.pack("waiting"), out.pack(waiting_.size());
        zmq_send(control_, buffer.data(), buffer.size(), ZMQ_DONTWAIT);
    }

    void step() {
        zmq_pollitem_t items[] = {{control_, 0, ZMQ_POLLIN, 0}};
        zmq_poll(items, 1, 20);
        char bytes[65536];
        for (int size; (size = zmq_recv(control_, bytes, sizeof bytes, ZMQ_DONTWAIT)) >= 0;) hear(bytes, size);
        std::int64_t now = now_ns();
        if (!is_welcome_ || now - moved_ > 2'000'000'000) {  // a new server, or nothing moves: ask where it stands
            if (now - said_ > 500'000'000) say_hello(), said_ = now;
        } else if (now - said_ > 500'000'000) {
            say_ping(), said_ = now;
        }
        while (is_welcome_ && now >= held_until_ && sent_ < waiting_.size() && sent_ < window_)
            if (!send(waiting_[sent_])) break;
    }

    bool send(const Keyframe& keyframe) {
        if (zmq_send(data_, keyframe.header.data(), keyframe.header.size(), ZMQ_SNDMORE | ZMQ_DONTWAIT) < 0)
            return false;
        zmq_send(data_, keyframe.depth.data(), keyframe.depth.size(), 0);
        ++sent_;
        return true;
    }

    void hear(const char* bytes, std::size_t size) {
        auto handle = msgpack::unpack(bytes, size);
        std::map<std::string, msgpack::object> message;
        handle.get().convert(message);
        auto type = message.at("type").as<std::string>();
        if (type == "welcome") {
            if (message.at("version").as<int>() != 3) throw std::runtime_error("the server speaks another version");
            epoch_ = message.at("epoch").as<std::string>();
            window_ = message.at("window_keyframes").as<std::size_t>();
            is_welcome_ = true;
            forget(message.at("durable").as<std::uint64_t>());
            sent_ = 0, moved_ = now_ns();
        } else if (type == "denied") {
            why_ = message.at("message").as<std::string>();
            if (message.at("reason").as<std::string>() != "opening") throw std::runtime_error(why_);
        } else if (type == "nack" && message.at("stage").as<std::string>() == "door") {
            throw std::runtime_error("refused: " + message.at("message").as<std::string>());
        } else if (type == "hold") {
            why_ = message.at("message").as<std::string>();
            held_until_ = now_ns() + std::int64_t(message.at("seconds").as<double>() * 1e9);
            sent_ = 0;
        } else if (type == "ack") {
            forget(message.at("durable").as<std::uint64_t>());
            if (message.at("resend").as<bool>()) sent_ = 0;
        } else if (type == "pong" && message.at("epoch").as<std::string>() != epoch_) {
            is_welcome_ = false;
        }
    }

    void forget(std::uint64_t durable) {
        for (; !waiting_.empty() && waiting_.front().seq <= durable; moved_ = now_ns()) {
            waiting_.pop_front();
            if (sent_) --sent_;
        }
    }

    void *context_, *data_, *control_;
    char session_[16];
    std::deque<Keyframe> waiting_;  // not acknowledged, in order; the first `sent_` of them are under way
    std::size_t sent_ = 0, window_ = 0;
    std::uint64_t last_ = 0;
    std::int64_t said_ = 0, moved_ = 0, held_until_ = 0;
    bool is_welcome_ = false;
    std::string epoch_, why_ = "nobody answers";
};

int main(int count, char** words) try {
    if (count != 8) throw std::runtime_error("usage: sender HOST PORT frames.txt FX FY CX CY");
    Client client(words[1], std::atoi(words[2]));
    std::array<double, 4> camera{std::atof(words[4]), std::atof(words[5]), std::atof(words[6]), std::atof(words[7])};
    std::ifstream list(words[3]);
    if (!list) throw std::runtime_error(std::string(words[3]) + " cannot be read");
    int frames = 0;
    for (std::string line; std::getline(list, line); ++frames) {
        std::istringstream words_of(line);
        std::string path;
        double x, y, z, a, b, c, w;
        if (!(words_of >> path >> x >> y >> z >> a >> b >> c >> w)) throw std::runtime_error("no frame: " + line);
        client.add(read_pgm(path), camera, pose_rows(x, y, z, a, b, c, w));
    }
    client.flush(60);
    std::cout << frames << " keyframes are on the server's disk\n";
} catch (const std::exception& error) {
    std::cerr << "sender: " << error.what() << "\n";
    return 1;
}
