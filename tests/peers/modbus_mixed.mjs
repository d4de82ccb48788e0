// A Modbus TCP client on an npm library that mostly reads, as PLCs do, and checks every word of every answer.
//
// usage: node modbus_mixed.mjs LIBRARY PORT REQUESTS TEMPLATE CONTROL [FOLDER with node_modules]
// TEMPLATE and CONTROL as for modbus_mixed.c. Prints how many requests were answered as they should be, or what was
// wrong, with exit status 1.
import { createRequire } from "node:module";
import fs from "node:fs";
import net from "node:net";

const [library, port, requests, template, control, folder] = process.argv.slice(2);
const require = createRequire(folder + "/");
const OWN = 4, BITS = 16, LONGEST = 125, ABSENT = 200, ILLEGAL_ADDRESS = 2;
const first = Number(control);

const rows = fs.readFileSync(template, "utf8").trim().split("\n").map((line) => line.split(" "));
const kind = new Map(rows.map(([address, k]) => [Number(address), k]));
const value = new Map(rows.map(([address, , v]) => [Number(address), Number(v)]));

function fail(request, what, address) {
  console.error(`request ${request}: ${what} at ${address}`);
  process.exit(1);
}

async function modbusSerial() {
  const Client = require("modbus-serial");
  const client = new Client();
  await client.connectTCP("127.0.0.1", { port: Number(port) });
  client.setID(1);
  client.setTimeout(20000);
  client._port.on("close", () => fail("-", "connection lost", "-"));
  return {
    input: async (a, c) => (await client.readInputRegisters(a, c)).data,
    holding: async (a, c) => (await client.readHoldingRegisters(a, c)).data,
    coils: async (a, c) => (await client.readCoils(a, c)).data,
    inputs: async (a, c) => (await client.readDiscreteInputs(a, c)).data,
    writeCoil: (a, bit) => client.writeCoil(a, bit),
    writeCoils: (a, bits) => client.writeCoils(a, bits),
    write: (a, words) => client.writeRegisters(a, words),
    writeOne: (a, word) => client.writeRegister(a, word),
    code: (error) => error.modbusCode,
  };
}

async function jsmodbus() {
  const { client: clients } = require("jsmodbus");
  const socket = new net.Socket();
  const client = new clients.TCP(socket, 1, 20000);
  await new Promise((done, refused) => {
    socket.on("connect", done);
    socket.on("error", refused);
    socket.connect({ host: "127.0.0.1", port: Number(port) });
  });
  socket.on("close", () => fail("-", "connection lost", "-"));
  const words = (answer) => Array.from(answer.response.body.valuesAsArray);
  return {
    input: async (a, c) => words(await client.readInputRegisters(a, c)),
    holding: async (a, c) => words(await client.readHoldingRegisters(a, c)),
    coils: async (a, c) => words(await client.readCoils(a, c)),
    inputs: async (a, c) => words(await client.readDiscreteInputs(a, c)),
    writeCoil: (a, bit) => client.writeSingleCoil(a, bit),
    writeCoils: (a, bits) => client.writeMultipleCoils(a, bits),
    write: (a, values) => client.writeMultipleRegisters(a, values),
    writeOne: (a, word) => client.writeSingleRegister(a, word),
    code: (error) => error.response?.body?.code,
  };
}

function check(request, address, count, words) {
  if (words.length !== count) fail(request, `${words.length} words`, address);
  let number = -1;
  words.forEach((word, i) => {
    const k = kind.get(address + i);
    if (k === "n" && number < 0) number = word;
    if (k === "n" && word !== number) fail(request, "torn", address + i);
    if (k === "c" && word !== value.get(address + i)) fail(request, "wrong", address + i);
  });
}

function setOwn(at, bits) {
  bits.forEach((bit, i) => {
    const [k, b] = [Math.floor((at + i) / BITS), (at + i) % BITS];
    own[k] = bit ? own[k] | (1 << b) : own[k] & ~(1 << b);
  });
}

function checkOwn(request, bits) {
  for (let i = 0; i < OWN * BITS; i++) {
    if (Boolean(bits[i]) !== Boolean((own[Math.floor(i / BITS)] >> (i % BITS)) & 1)) fail(request, "bit not as written", i);
  }
}

const client = await { "modbus-serial": modbusSerial, jsmodbus }[library]();
const own = [0, 0, 0, 0];
async function ask(i) {
  const at = (i * 7) % 100, count = 1 + (i % 25);
  switch (i % 8 < 7 ? i % 5 : 5 + Math.floor(i / 8) % 5) {
    case 0: return check(i, 0, LONGEST, await client.input(0, LONGEST));
    case 1: return check(i, 0, LONGEST, await client.holding(0, LONGEST));
    case 2: return check(i, 1000, LONGEST, await client.holding(1000, LONGEST));
    case 3: return check(i, at, count, await client.input(at, count));
    case 5:
      own.forEach((_, k) => { own[k] = (i + k) & 0xffff; });
      return client.write(first, [...own]);
    case 6:
      own[1] = (own[1] * 3) & 0xffff;
      return client.writeOne(first + 1, own[1]);
    case 7: {
      const code = await client.holding(ABSENT, 1).then(() => 0, client.code);
      if (code !== ILLEGAL_ADDRESS) fail(i, `answer ${code}, not a refusal`, ABSENT);
      return undefined;
    }
    case 8: {
      const bits = Array.from({ length: 20 }, (_, k) => ((i >> k) & 1) === 1);
      setOwn(BITS + 3, bits);
      await client.writeCoils(first * BITS + BITS + 3, bits);
      return checkOwn(i, await client.inputs(first * BITS, OWN * BITS));
    }
    case 9: {
      const bit = (own[0] & 0x80) === 0;
      setOwn(7, [bit]);
      await client.writeCoil(first * BITS + 7, bit);
      return checkOwn(i, await client.coils(first * BITS, OWN * BITS));
    }
    default: {
      const words = await client.holding(first, OWN);
      if (words.some((word, k) => word !== own[k])) fail(i, "not as written", first);
      return undefined;
    }
  }
}

try {
  for (let i = 0; i < Number(requests); i++) await ask(i);
} catch (error) {
  fail("-", error?.message ?? JSON.stringify(error), "-");
}
console.log(requests);
process.exit(0);
